// The npm package by other people's checks: publint (manifest), attw (whether types and modules resolve) and TypeScript
// over every entry, in strict mode, as bundlers and as Node resolve them. `.ci/run` installs the checks (PLAYWRIGHT).

import assert from 'node:assert/strict';
import { execFileSync, spawnSync } from 'node:child_process';
import { existsSync, mkdirSync, mkdtempSync, rmSync, symlinkSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';

const PACKAGE = fileURLToPath(new URL('../../npm/', import.meta.url));
const MODULES = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules');
/// Programs of the checks, below their packages.
const PUBLINT = path.join(MODULES, 'publint/src/cli.js');
const ATTW = path.join(MODULES, '@arethetypeswrong/cli/dist/index.js');
const TSC = path.join(MODULES, 'typescript/bin/tsc');
const missing = [PUBLINT, ATTW, TSC].find((file) => !existsSync(file));
if (missing && process.env.REQUIRE_BUNDLERS === '1') throw new Error(`${missing} does not exist`);
const options = { skip: missing ? `needs ${missing}` : false };

const work = mkdtempSync(path.join(tmpdir(), 'splat4d-lints-'));
const [{ filename }] = JSON.parse(execFileSync('npm', ['pack', '--json', '--pack-destination', work], { cwd: PACKAGE, stdio: ['ignore', 'pipe', 'ignore'] }));
const tarball = path.join(work, filename);
test.after(() => rmSync(work, { recursive: true }));

/// Runs a program of Node; what it printed is the message of a failure.
function check(program, ...args) {
  const { status, stdout, stderr } = spawnSync(process.execPath, [program, ...args], { cwd: work, encoding: 'utf8' });
  assert.equal(status, 0, stdout + stderr);
}

test('publint accepts the package', options, () => check(PUBLINT, 'run', tarball, '--strict'));

// The package is a package of modules: `require` of it is left out.
test('every entry resolves with its types', options, () => check(ATTW, tarball, '--profile', 'esm-only'));

/// Every entry, one name of each used.
const ENTRIES = `
import { Splat4D, type CameraState } from 'splat4d';
import { Splat4D as Same } from 'splat4d/player/element.js';
import { Splat4D as ReactElement } from 'splat4d/react';
import { Splat4D as ThreeObject } from 'splat4d/three';
import { Frames } from 'splat4d/frames';
import { SETTINGS, Splat4D as SparkObject } from 'splat4d/spark';
import { Splat4D as PlayCanvasObject } from 'splat4d/playcanvas';
import { Splat4D as BabylonObject } from 'splat4d/babylon';
const element: Splat4D = document.createElement('splat-4d');
const camera: CameraState = element.camera;
element.addEventListener('timeupdate', (event) => event.detail.time.toFixed(1));
element.volume = element.muted ? 0.5 : 1;
const object = new ThreeObject('knight.s4d', { up: 'z', sound: true });
if (object.sound?.there && object.sound.blocked) object.sound.touched();
object.position.set(0, object.duration, camera.fov);
export default [Same, ReactElement, Frames, SETTINGS, SparkObject, PlayCanvasObject, BabylonObject];
// @ts-expect-error: there is no such axis
new ThreeObject('knight.s4d', { up: 'w' });
`;

for (const [module, moduleResolution] of [['esnext', 'bundler'], ['nodenext', 'nodenext']]) {
  test(`types are strict, resolved by ${moduleResolution}`, options, () => {
    const folder = path.join(work, moduleResolution);
    const modules = path.join(folder, 'node_modules');
    mkdirSync(path.join(modules, 'splat4d'), { recursive: true });
    execFileSync('tar', ['-xzf', tarball, '-C', path.join(modules, 'splat4d'), '--strip-components=1']);
    // Links: what an engine imports by itself is found next to the linked package.
    for (const name of ['three', '@types/three', '@types/react', '@sparkjsdev/spark', 'playcanvas', '@babylonjs/core']) {
      mkdirSync(path.dirname(path.join(modules, name)), { recursive: true });
      symlinkSync(path.join(MODULES, name), path.join(modules, name), 'junction');
    }
    writeFileSync(path.join(folder, 'package.json'), '{ "type": "module" }');
    writeFileSync(path.join(folder, 'entries.ts'), ENTRIES);
    const compilerOptions = { strict: true, noEmit: true, target: 'es2022', lib: ['es2024', 'dom', 'dom.iterable'], module, moduleResolution, types: [] };
    writeFileSync(path.join(folder, 'tsconfig.json'), JSON.stringify({ compilerOptions, files: ['entries.ts'] }));
    const { stdout } = spawnSync(process.execPath, [TSC, '-p', folder, '--pretty', 'false'], { cwd: folder, encoding: 'utf8' });
    // The engines' own declarations are theirs to mend.
    const ours = stdout.split('\n').filter((line) => /^(entries\.ts|node_modules\/splat4d\/)/.test(line));
    assert.deepEqual(ours, []);
  });
}
