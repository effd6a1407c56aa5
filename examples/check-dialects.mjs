// The chores of check-dialects.sh that need a program: Gaussians synthetic, files compared, images compared. Reads and
// writes plain .ply files with a reader of its own, so that no error of ours can hide.
import { readFileSync, writeFileSync } from 'node:fs';

/// Gaussians that are synthetic.
const COUNT = 5000;
/// SH basis function of degree 0, 1/(2√π).
const SH_C0 = 0.28209479177387814;
/// The largest difference two readers of one file may have: position (share of the scene), log scale, turn (radians),
/// opacity, base colour, SH. Readers agree to rounding, except that 255 steps of a .splat's quaternion are read around
/// 127.5 or 128, and that opacities of 0 and 1 have no logit.
const EXACT = { mean: 1e-5, scale: 1e-4, turn: 2e-3, opacity: 0.002, color: 1e-4, sh: 1e-4 };
const TOLERANCES = { splat: { ...EXACT, turn: 0.02 } };

/// A repeatable stream of normal numbers (mulberry32, Box-Muller).
function normals(seed) {
  const uniform = () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
  return () => Math.sqrt(-2 * Math.log(1 - uniform())) * Math.cos(2 * Math.PI * uniform());
}

function writePly(path, names, rows) {
  const properties = names.map((n) => `property float ${n}\n`).join('');
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${rows.length}\n${properties}end_header\n`;
  const body = new Float32Array(rows.flat());
  writeFileSync(path, Buffer.concat([Buffer.from(header), Buffer.from(body.buffer)]));
}

function readPly(path) {
  const bytes = readFileSync(path);
  const end = bytes.indexOf('end_header\n') + 11;
  const lines = bytes.subarray(0, end).toString().split('\n');
  const names = lines.filter((l) => l.startsWith('property float ')).map((l) => l.slice(15));
  const count = Number(lines.find((l) => l.startsWith('element vertex ')).slice(15));
  const data = new Float32Array(bytes.buffer.slice(bytes.byteOffset + end, bytes.byteOffset + end + 4 * count * names.length));
  const column = (name) => {
    const at = names.indexOf(name);
    return at < 0 ? undefined : (row) => data[row * names.length + at];
  };
  return { names, count, column };
}

const plainNames = (rest) => ['x', 'y', 'z', 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2',
  ...Array.from({ length: rest }, (_, i) => `f_rest_${i}`),
  'opacity', 'scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3'];

function make(path) {
  const n = normals(7);
  const rows = Array.from({ length: COUNT }, () => [
    n(), n(), n(), 0, 0, 0, n(), n(), n(), ...Array.from({ length: 45 }, () => 0.15 * n()),
    2 * n(), n() * 0.5 - 3.5, n() * 0.5 - 3.5, n() * 0.5 - 4, n(), n(), n(), n()]);
  writePly(path, plainNames(45), rows);
}

function makeStg(path) {
  const n = normals(8);
  const names = ['x', 'y', 'z', 'trbf_center', 'trbf_scale', 'nx', 'ny', 'nz',
    ...Array.from({ length: 9 }, (_, i) => `motion_${i}`), 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity',
    'scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3', 'omega_0', 'omega_1', 'omega_2', 'omega_3'];
  const color = () => 1 / (1 + Math.exp(-n()));
  const rows = Array.from({ length: COUNT }, () => [
    n(), n(), n(), 0.5 + 0.3 * n(), 0.5 * n(), 0, 0, 0, ...Array.from({ length: 9 }, () => 0.5 * n()),
    color(), color(), color(), n(), n() - 4, n() - 4, n() - 4, n(), n(), n(), n(), n(), n(), n(), n()]);
  writePly(path, names, rows);
}

const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/// Largest differences of two files of the same Gaussians in the same order.
function compare(a, b, kind) {
  const [p, q] = [readPly(a), readPly(b)];
  if (p.count !== q.count) return `DIFFERENT: ${p.count} and ${q.count} Gaussians`;
  const worst = { mean: 0, scale: 0, turn: 0, opacity: 0, color: 0, sh: 0 };
  let size = 0;
  const note = (key, x) => { if (!(x <= worst[key])) worst[key] = x; };
  const pairs = (names) => names.map((n) => [p.column(n), q.column(n)]).filter(([f, g]) => f || g);
  const missing = (f) => f ?? (() => 0);
  const groups = { mean: ['x', 'y', 'z'], scale: ['scale_0', 'scale_1', 'scale_2'],
    color: ['f_dc_0', 'f_dc_1', 'f_dc_2'], sh: plainNames(45).filter((n) => n.startsWith('f_rest')) };
  for (const [key, names] of Object.entries(groups)) {
    // f_rest is channel-major: files of different degree cannot be compared by name, and must not occur.
    for (const [f, g] of pairs(names)) {
      for (let i = 0; i < p.count; i++) {
        const x = missing(f)(i);
        if (key === 'mean') size = Math.max(size, Math.abs(x));
        note(key, Math.abs(x - missing(g)(i)));
      }
    }
  }
  const rotation = ['rot_0', 'rot_1', 'rot_2', 'rot_3'];
  const unit = (file, i) => {
    const v = rotation.map((n) => file.column(n)(i));
    const norm = Math.hypot(...v);
    return v.map((x) => x / norm);
  };
  for (let i = 0; i < p.count; i++) {
    // A Gaussian looks the same after half a turn about one of its own axes: programs that flip axes make those.
    const [u, [w, x, y, z]] = [unit(p, i), unit(q, i)];
    const twins = [[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]];
    const apart = (v, sign) => Math.hypot(...u.map((a, k) => a - sign * v[k]));
    const nearest = Math.min(...twins.flatMap((v) => [apart(v, 1), apart(v, -1)]));
    note('turn', 4 * Math.asin(Math.min(1, nearest / 2)));
    note('opacity', Math.abs(sigmoid(p.column('opacity')(i)) - sigmoid(q.column('opacity')(i))));
  }
  worst.mean /= size || 1;
  const limits = TOLERANCES[kind] ?? EXACT;
  const bad = Object.keys(worst).filter((k) => !(worst[k] <= limits[k]));
  const text = Object.entries(worst).map(([k, x]) => `${k} ${x.toExponential(0)}`).join(' ');
  return `${bad.length ? `DIFFERENT (${bad.join(', ')})` : 'alike'}: ${text}`;
}

/// A camera that looks at the inner part of all Gaussians from the side of −z.
function camera(ply, path) {
  const file = readPly(ply);
  const middle = ['x', 'y', 'z'].map((n) => {
    const all = Float32Array.from({ length: file.count }, (_, i) => file.column(n)(i)).sort();
    return [all[all.length >> 1], all[Math.floor(all.length * 0.95)] - all[Math.floor(all.length * 0.05)]];
  });
  const away = 1.2 * Math.max(...middle.map((m) => m[1]), 1e-3);
  const t = [-middle[0][0], -middle[1][0], -middle[2][0] + away];
  const pose = [[1, 0, 0, t[0]], [0, 1, 0, t[1]], [0, 0, 1, t[2]], [0, 0, 0, 1]];
  writeFileSync(path, JSON.stringify({ fx: 480, fy: 480, cx: 240, cy: 240, w: 480, h: 480, world_to_camera: pose }));
}

function readNpy(path) {
  const bytes = readFileSync(path);
  const header = 10 + bytes.readUInt16LE(8);
  return new Float32Array(bytes.buffer.slice(bytes.byteOffset + header, bytes.byteOffset + bytes.length));
}

function decibel(a, b) {
  const [x, y] = [readNpy(a), readNpy(b)];
  const clamp = (v) => Math.min(1, Math.max(0, v));
  const sum = x.reduce((s, v, i) => s + (clamp(v) - clamp(y[i])) ** 2, 0);
  return sum === 0 ? 'inf' : (-10 * Math.log10(sum / x.length)).toFixed(1);
}

/// Lets gsplat.js load a .splatv file, and compares the words of its texture with the .ply it was made of.
async function splatv(path, ply) {
  Object.assign(globalThis, { self: globalThis, window: globalThis, document: { createElement: () => ({}) } });
  const { SplatvLoader } = await import('gsplat');
  const bytes = readFileSync(path);
  const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
  const { data } = SplatvLoader._ParseSplatvBuffer(buffer, { addObject() {} }, {});
  const words = data.data;
  const floats = new Float32Array(words.buffer, words.byteOffset, words.length);
  const half = (i, upper) => {
    const bits = upper ? words[i] >>> 16 : words[i] & 0xffff;
    const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
    return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
  };
  const file = readPly(ply);
  const column = (n) => file.column(n);
  const [motion, axes] = [Array.from({ length: 9 }, (_, k) => column(`motion_${k}`)), ['x', 'y', 'z'].map(column)];
  let worst = { path: 0, fade: 0, color: 0 };
  for (let i = 0; i < file.count; i++) {
    const o = 16 * i;
    for (const t of [0, 0.25, 0.5, 1]) {
      // As the shader has it: halves 2k and 2k+1 of word 8 + k; the file's clock and the .ply's are both one clip long.
      const dt = t - half(o + 15, false);
      const m = (k) => half(o + 8 + (k >> 1), k & 1);
      const d = t - column('trbf_center')(i);
      for (let a = 0; a < 3; a++) {
        const theirs = floats[o + a] + dt * (m(a) + dt * (m(3 + a) + dt * m(6 + a)));
        const truth = axes[a](i) + d * (motion[a](i) + d * (motion[3 + a](i) + d * motion[6 + a](i)));
        worst.path = Math.max(worst.path, Math.abs(theirs - truth));
      }
      const fade = Math.exp(-((dt / half(o + 15, true)) ** 2));
      const truth = Math.exp(-((d / Math.exp(column('trbf_scale')(i))) ** 2));
      worst.fade = Math.max(worst.fade, Math.abs(fade - truth));
    }
    const rgba = words[o + 7];
    ['f_dc_0', 'f_dc_1', 'f_dc_2'].forEach((n, c) => {
      worst.color = Math.max(worst.color, Math.abs(((rgba >>> (8 * c)) & 255) / 255 - column(n)(i)));
    });
    worst.color = Math.max(worst.color, Math.abs((rgba >>> 24) / 255 - sigmoid(column('opacity')(i))));
  }
  // Eleven bits of paths of some units and of a fade, half a byte of colour.
  const fine = worst.path < 0.01 && worst.fade < 0.005 && worst.color < 0.0021;
  const text = Object.entries(worst).map(([k, x]) => `${k} ${x.toExponential(1)}`).join(' ');
  console.log(`gsplat.js loads our .splatv            ${fine ? 'alike' : 'DIFFERENT'}: ${text}`);
  return fine;
}

const [verb, ...rest] = process.argv.slice(2);
const verbs = {
  make, 'make-stg': makeStg, camera,
  compare: (...a) => console.log(compare(...a)),
  decibel: (...a) => console.log(decibel(...a)),
  splatv: async (...a) => process.exit((await splatv(...a)) ? 0 : 1),
};
await verbs[verb](...rest);
