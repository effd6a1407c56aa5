#!/usr/bin/env bash
# Checks our files against other people's programs: PlayCanvas' splat-transform and gsplat.js, installed from npm into a
# temporary folder with the Node 22 that splat-transform 3 needs. Not a part of the tests, because it needs a network.
#
#   examples/check-dialects.sh                 synthetic Gaussians
#   examples/check-dialects.sh FILE...         these as well: anything that splat4d opens
#   SPLAT4D=PROGRAM examples/check-dialects.sh without building
#
# For every format: what we write, both programs read, and must read alike; what they write likewise. The last column is
# the difference of images against the original, in dB.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT

ours="${SPLAT4D:-}"
if [ -z "$ours" ]; then
    cargo build --release --manifest-path "$here/../Cargo.toml" -p splat4d
    target="$(cargo metadata --format-version 1 --no-deps --manifest-path "$here/../Cargo.toml" |
        node -e 'process.stdout.write(JSON.parse(require("fs").readFileSync(0)).target_directory)')"
    ours="$target/release/splat4d"
fi
(cd "$work" && npm init -y >/dev/null && npm install --silent --no-fund --no-audit node@22 @playcanvas/splat-transform@3 gsplat@1)
node="$work/node_modules/.bin/node"
theirs() { "$node" "$work/node_modules/@playcanvas/splat-transform/bin/cli.mjs" -q -w "$@" >/dev/null; }
theirs_version="$("$node" "$work/node_modules/@playcanvas/splat-transform/bin/cli.mjs" --version | head -1)"
tool() { node "$here/check-dialects.mjs" "$@"; }
convert() { "$ours" convert -q "$@" 2>>"$work/warnings"; }
failed=0
echo "splat-transform $theirs_version"

# picture NAME: the Gaussians of NAME.ply, seen by the camera of the original.
picture() { "$ours" render -q "$1.ply" --camera "$work/camera.json" -o "$work/view.png" --raw "$1"; }

# both NAME FILE: what each program makes of FILE, compared.
both() {
    convert "$2" "$work/a.ply" && theirs "$2" "$work/b.ply" || { echo "$1: does not open"; failed=1; return; }
    picture "$work/a"
    printf '%-34s %s  %s dB\n' "$1" "$(tool compare "$work/a.ply" "$work/b.ply" "$3")" \
        "$(tool decibel "$work/original.npy" "$work/a.npy")"
    case "$(tool compare "$work/a.ply" "$work/b.ply" "$3")" in *DIFFERENT*) failed=1 ;; esac
}

check() {
    echo "-- $1"
    convert "$1" "$work/original.ply"
    tool camera "$work/original.ply" "$work/camera.json"
    picture "$work/original"
    both "we write .ply" "$work/original.ply" exact
    for ending in compressed.ply splat; do
        convert "$work/original.ply" "$work/x.$ending"
        both "we write .$ending" "$work/x.$ending" "$ending"
    done
    for version in 2 3 4; do
        convert "$work/original.ply" "$work/x.spz" --spz-version $version
        both "we write .spz version $version" "$work/x.spz" spz
    done
    for ending in ply compressed.ply sog; do
        theirs "$work/original.ply" "$work/y.$ending" -g cpu 2>/dev/null || theirs "$work/original.ply" "$work/y.$ending"
        both "they write .$ending" "$work/y.$ending" "$ending"
    done
    mkdir -p "$work/folder" && theirs "$work/original.ply" "$work/folder/meta.json" -g cpu 2>/dev/null ||
        theirs "$work/original.ply" "$work/folder/meta.json"
    both "they write a SOG folder" "$work/folder/meta.json" sog
    for version in 3 4; do
        theirs "$work/original.ply" "$work/y.spz" --spz-version $version
        both "they write .spz version $version" "$work/y.spz" spz
    done
}

tool make "$work/made.ply"
for file in "$work/made.ply" "$@"; do check "$file"; done

echo "-- moving Gaussians"
tool make-stg "$work/made.stg.ply"
convert "$work/made.stg.ply" "$work/made.splatv"
(cd "$work" && cp "$here/check-dialects.mjs" . && node check-dialects.mjs splatv made.splatv made.stg.ply) || failed=1
exit $failed
