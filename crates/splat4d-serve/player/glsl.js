// The WebGL2 backend's shaders: the twins of render/project.rs, math/sh.rs and docs/format.md.

import { LOW_PASS, SH } from './constants.js';

/// What an image shows; the numbers are those of the shaders.
export const CHANNELS = { color: 0, depth: 1, alpha: 2, flow: 3 };
/// Texels (RGBA32F) of a block in the block texture: 24 numbers of its header, then span from, span to, first row of
/// its palette or -1, SH degree, then the palette's three ranges, then the span's length.
export const BLOCK_TEXELS = 8;

/// Texels across the textures of orders and of splats.
export const ORDER_WIDTH = 1024;

/// What both ways of drawing share: unpacks, moves, projects and shades one Gaussian.
///
/// Culls: outside its span, z ≤ near, opacity·σ < 1/255, determinant ≤ 0, nothing in the image.
/// Constants: low-pass 0.3 px² and α ≥ 1/255 of Kerbl et al. 2023, τ margin of project.rs.
export const SPLAT = `#version 300 es
precision highp float; precision highp int;
precision highp sampler2D; precision highp usampler2D;
uniform usampler2D words, palette, order;
uniform sampler2D blocks;
uniform mat3 rotation;
uniform vec3 translation, eye;
uniform vec2 focal, center, size, low, high, depth_range;
uniform float time, near, flow_scale;
uniform int channel, count;

// conic xx xy yy and opacity; centre and half of the long axis of the ellipse α = 1/255, px; colour, and the short axis
// as a share of the long one; z in camera axes.
struct Splat { vec4 shape, place, tint; float depth; };

const float LOW_PASS = ${LOW_PASS}, ALPHA_MIN = 1.0 / 255.0, TAU_MARGIN = 1e-3;
// Only an order that is older than this image can hold pages outside their span: s.
const float SPAN_SLACK = 1e-4;
const int BLOCK_TEXELS = ${BLOCK_TEXELS}, PALETTE_WIDTH = 2048;

uint bits(uint word, int first, int count) { return (word >> first) & ((1u << count) - 1u); }
float share(uint word, int first) { return float(bits(word, first, 8)) / 255.0; }
float lerp(float a, float b, float u) { return a + (b - a) * u; }
vec3 signed10(uint word) {
  return (vec3(bits(word, 0, 10), bits(word, 10, 10), bits(word, 20, 10)) - 511.0) / 511.0;
}

vec3 harmonics(vec3 d, int first, int label, int degree, vec3 ranges) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[15];
  basis[0] = -${SH.first} * y; basis[1] = ${SH.first} * z; basis[2] = -${SH.first} * x;
  basis[3] = ${SH.product} * x * y; basis[4] = -${SH.product} * y * z;
  basis[5] = ${SH.axial} * (2.0 * zz - xx - yy);
  basis[6] = -${SH.product} * x * z; basis[7] = ${SH.difference} * (xx - yy);
  basis[8] = -${SH.third} * y * (3.0 * xx - yy); basis[9] = ${SH.triple} * x * y * z;
  basis[10] = -${SH.side} * y * (4.0 * zz - xx - yy);
  basis[11] = ${SH.pole} * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
  basis[12] = -${SH.side} * x * (4.0 * zz - xx - yy); basis[13] = ${SH.cone} * z * (xx - yy);
  basis[14] = -${SH.third} * x * (xx - 3.0 * yy);
  int count = (degree + 1) * (degree + 1) - 1, at = first * PALETTE_WIDTH + label * count;
  vec3 sum = vec3(0);
  for (int k = 0; k < count; k++) {
    int texel = at + k;
    vec3 code = vec3(texelFetch(palette, ivec2(texel % PALETTE_WIDTH, texel / PALETTE_WIDTH), 0).rgb);
    float range = k < 3 ? ranges.x : k < 8 ? ranges.y : ranges.z;
    sum += basis[k] * range * (code - 128.0) / 127.0;
  }
  return sum;
}

// Direction as hue, speed as value.
vec3 flow_color(vec2 velocity) {
  float hue = atan(velocity.y, velocity.x) / 6.283185307179586;
  float value = min(length(velocity) / flow_scale, 1.0);
  return value * clamp(abs(fract(hue + vec3(0, 2.0 / 3.0, 1.0 / 3.0)) * 6.0 - 3.0) - 1.0, 0.0, 1.0);
}

// The splat at a place of the order; a long axis of 0: nothing to draw.
Splat splat(ivec2 texel) {
  Splat none = Splat(vec4(0), vec4(0), vec4(0), 0.0);
  if (texel.y * ${ORDER_WIDTH} + texel.x >= count) return none;
  uint id = texelFetch(order, texel, 0).r;
  int row = int(id >> 10), column = int(id & 1023u), b = (column >> 8) * BLOCK_TEXELS;
  uvec4 p = texelFetch(words, ivec2(2 * column, row), 0), q = texelFetch(words, ivec2(2 * column + 1, row), 0);
  vec4 h0 = texelFetch(blocks, ivec2(b, row), 0), h1 = texelFetch(blocks, ivec2(b + 1, row), 0);
  vec4 h2 = texelFetch(blocks, ivec2(b + 2, row), 0), h3 = texelFetch(blocks, ivec2(b + 3, row), 0);
  vec4 h4 = texelFetch(blocks, ivec2(b + 4, row), 0), h5 = texelFetch(blocks, ivec2(b + 5, row), 0);
  vec4 page = texelFetch(blocks, ivec2(b + 6, row), 0), more = texelFetch(blocks, ivec2(b + 7, row), 0);
  if (time < page.x - SPAN_SLACK || time >= page.y + SPAN_SLACK) return none;

  // Life.
  float dt = time - lerp(h1.z, h1.w, float(p.y >> 16) / 65535.0);
  uint wide = q.z >> 24;
  float half_width = wide == 0u ? 0.0 : exp(lerp(h3.z, h3.w, (float(wide) - 1.0) / 253.0));
  float soft = max(exp(lerp(h4.x, h4.y, share(q.w, 16))), 1e-30);
  float outside = wide == 255u ? 0.0 : max(0.0, abs(dt) - half_width) / soft;
  float opacity = share(p.z, 24) * exp(-0.5 * outside * outside);
  if (!(opacity >= ALPHA_MIN)) return none;
  float reach = wide == 255u ? 0.5 * more.w : min(half_width + 3.0 * soft, more.w);

  // Motion.
  vec3 place = vec3(p.x & 65535u, p.x >> 16, p.y & 65535u) / 65535.0;
  vec3 velocity = h3.x * signed10(q.x) / reach;
  vec3 mean = h0.xyz + (vec3(h0.w, h1.xy) - h0.xyz) * place + velocity * dt;
  vec3 rest = signed10(p.w).zyx * 0.7071067811865476;
  float most = sqrt(max(0.0, 1.0 - dot(rest, rest)));
  uint largest = p.w >> 30;
  vec4 r = largest == 0u ? vec4(most, rest) : largest == 1u ? vec4(rest.x, most, rest.yz)
    : largest == 2u ? vec4(rest.xy, most, rest.z) : vec4(rest, most);
  vec3 turn = 0.5 * dt * h3.y * signed10(q.y) / reach;
  r = normalize(r + vec4(-dot(turn, r.yzw), r.x * turn + cross(turn, r.yzw)));

  // Projection (EWA).
  vec3 c = rotation * mean + translation;
  if (!(c.z > near)) return none;
  vec2 uv = c.xy / c.z, clamped = clamp(uv, low, high);
  vec3 scale = exp(h2.z + (h2.w - h2.z) * vec3(share(p.z, 0), share(p.z, 8), share(p.z, 16)));
  mat3 axes = mat3(
    1.0 - 2.0 * (r.z * r.z + r.w * r.w), 2.0 * (r.y * r.z + r.x * r.w), 2.0 * (r.y * r.w - r.x * r.z),
    2.0 * (r.y * r.z - r.x * r.w), 1.0 - 2.0 * (r.y * r.y + r.w * r.w), 2.0 * (r.z * r.w + r.x * r.y),
    2.0 * (r.y * r.w + r.x * r.z), 2.0 * (r.z * r.w - r.x * r.y), 1.0 - 2.0 * (r.y * r.y + r.z * r.z));
  mat3 world = transpose(rotation);
  vec3 m0 = focal.x / c.z * (world[0] - clamped.x * world[2]), m1 = focal.y / c.z * (world[1] - clamped.y * world[2]);
  // Rows of J W times the root of the covariance: their products are the screen covariance.
  vec3 a0 = (m0 * axes) * scale, a1 = (m1 * axes) * scale;
  float sxx = dot(a0, a0), sxy = dot(a0, a1), syy = dot(a1, a1);
  float xx = sxx + LOW_PASS, yy = syy + LOW_PASS;
  // det(Σ + λI) written so that a needle's determinant cannot cancel to nothing.
  float det = max(sxx * syy - sxy * sxy, 0.0) + LOW_PASS * (sxx + syy + LOW_PASS);
  float tau = 2.0 * log(opacity / ALPHA_MIN) + TAU_MARGIN;
  vec2 extent = sqrt(tau * vec2(xx, yy));
  vec2 middle = focal * uv + center;
  vec2 first = middle - extent, last = middle + extent;
  // Phrased so that a NaN is culled too.
  if (!(det > 0.0 && last.x > 0.0 && last.y > 0.0 && first.x < size.x && first.y < size.y)) return none;

  vec3 tint = vec3(1);
  if (channel == ${CHANNELS.color}) {
    tint = vec3(h4.zw, h5.x) + (h5.yzw - vec3(h4.zw, h5.x)) * vec3(share(q.z, 0), share(q.z, 8), share(q.z, 16));
    if (page.z >= 0.0) {
      tint += harmonics(normalize(mean - eye), int(page.z), int(q.w & 65535u), int(page.w), more.xyz);
    }
    tint = max(tint, 0.0);
  } else if (channel == ${CHANNELS.depth}) {
    tint = vec3((c.z - depth_range.x) / (depth_range.y - depth_range.x));
  } else if (channel == ${CHANNELS.flow}) {
    vec3 v = rotation * velocity;
    tint = flow_color(focal * (v.xy - uv * v.z) / c.z);
  }
  float mid = 0.5 * (xx + yy), most_px = mid + sqrt(max(mid * mid - det, 0.0)), share_px = sqrt(det) / most_px;
  // The eigenvector of the larger eigenvalue, from the row that does not cancel.
  vec2 along = xx > yy ? vec2(most_px - yy, sxy) : vec2(sxy, most_px - xx);
  float norm = length(along);
  vec2 axis = (norm > 0.0 ? along / norm : vec2(1, 0)) * sqrt(tau * most_px);
  return Splat(vec4(yy / det, -sxy / det, xx / det, opacity), vec4(middle, axis), vec4(tint, share_px), c.z);
}
`;

/// Splats an instance. One each would be slow: graphics processors fill their lanes from one instance, and SwiftShader
/// starts again for each (measured: about 50 µs an instance).
export const BATCH = 256;

/// Four corners a splat, close around its ellipse: a needle's upright box would be empty for the most part.
const QUAD = `
flat out vec4 shape;
flat out vec2 middle;
flat out vec3 tint;
void main() {
  int i = gl_InstanceID * ${BATCH} + (gl_VertexID >> 2), corner = gl_VertexID & 3;
  Splat s = splat(ivec2(i % ${ORDER_WIDTH}, i / ${ORDER_WIDTH}));
  shape = s.shape;
  middle = s.place.xy;
  tint = s.tint.rgb;
  vec2 axis = s.place.zw, side = vec2((corner & 1) * 2 - 1, (corner >> 1) * 2 - 1);
  vec2 at = middle + side.x * axis + side.y * s.tint.w * vec2(-axis.y, axis.x);
  // Rows run from the top in this target; the copy to the canvas flips them.
  gl_Position = vec4(at / size * 2.0 - 1.0, 0, 1);
  if (axis == vec2(0)) gl_Position = vec4(2, 2, 0, 1);
}`;

/// Every corner computes its splat: where no 32-bit floats can be rendered to.
export const DIRECT_VERTEX = SPLAT + QUAD;

/// One fragment a splat of the order: each is computed once, not once a corner.
export const PROJECT_FRAGMENT = `${SPLAT}
layout(location = 0) out vec4 shape;
layout(location = 1) out vec4 place;
layout(location = 2) out vec4 tint;
void main() {
  Splat s = splat(ivec2(gl_FragCoord.xy));
  shape = s.shape;
  place = s.place;
  tint = s.tint;
}`;

/// Corners from what PROJECT_FRAGMENT wrote.
export const DRAW_VERTEX = `#version 300 es
precision highp float; precision highp int;
uniform highp sampler2D shapes, places, tints;
uniform vec2 size;
struct Splat { vec4 shape, place, tint; };
Splat splat(ivec2 texel) {
  return Splat(texelFetch(shapes, texel, 0), texelFetch(places, texel, 0), texelFetch(tints, texel, 0));
}
${QUAD}`;

/// α = min(0.99, o·exp(−½ dᵀ conic d)), below 1/255 nothing (Kerbl et al. 2023). Writes premultiplied colour.
export const DRAW_FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 shape;
flat in vec2 middle;
flat in vec3 tint;
out vec4 color;
void main() {
  vec2 d = gl_FragCoord.xy - middle;
  float alpha = shape.w * exp(-0.5 * (shape.x * d.x * d.x + shape.z * d.y * d.y) - shape.y * d.x * d.y);
  if (!(alpha >= 1.0 / 255.0)) discard;
  alpha = min(alpha, 0.99);
  color = vec4(tint * alpha, alpha);
}`;

/// One triangle over everything.
export const SHOW_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1);
}`;

/// From the blended sums to what is seen.
export const SHOW_FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D sums;
uniform vec3 background;
// 1, or 0 where the background is not rendered here.
uniform float opaque;
uniform ivec2 origin;
// Height of the image where rows must be turned round, else 0.
uniform int turned;
uniform int channel;
out vec4 color;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) - origin;
  if (turned > 0) at.y = turned - 1 - at.y;
  vec4 sum = texelFetch(sums, at, 0);
  vec3 rgb = sum.rgb + (1.0 - sum.a) * background;
  if (channel == ${CHANNELS.alpha}) rgb = vec3(sum.a);
  // Near is white, far black; black as well where little is drawn.
  if (channel == ${CHANNELS.depth}) rgb = sum.a < 0.5 ? vec3(0) : vec3(1.0 - sum.r / sum.a);
  color = vec4(clamp(rgb, 0.0, 1.0), max(sum.a, opaque));
}`;
