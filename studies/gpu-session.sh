#!/usr/bin/env bash
# Measures the GPU engine in one session on a graphics card: kernel tests, stages, kernel constants, training, gsplat.
#
#   studies/gpu-session.sh OUT          about 25 minutes
#   studies/gpu-session.sh OUT small    everything once with small sizes, on any driver, to test the session itself
#
# Nothing is downloaded or compiled except gsplat's kernels. No part waits for another's result: each has a time limit in
# seconds, and its output, exit status and duration are written as soon as it ends. Build first:
#
#   cargo build --release -p splat4d -p studies
#   cargo test --release --no-run -p splat4d-core -p splat4d-train --features gpu --lib
#
# BIN: folder of the programs (target/release). TESTS: the test programs that `--no-run` printed. PYTHON: an interpreter
# with PyTorch, gsplat 1.5.3 and fused-ssim; without one the comparison fails and the rest is measured.
set -u
out=${1:?usage: gpu-session.sh OUT [small]}
size=${2:-full}
bin=${BIN:-target/release}
# A software driver takes several times as long, even for small sizes.
slower=1
[ "$size" = small ] && slower=5
mkdir -p "$out"
printf 'part\tseconds\tstatus\n' > "$out/summary.tsv"

part() {
    local name=$1 limit=$2 start=$SECONDS status
    shift 2
    timeout --kill-after=10 $((slower * limit)) "$@" > "$out/$name.txt" 2>&1
    status=$?
    printf '%s\t%s\t%s\n' "$name" $((SECONDS - start)) "$status" | tee -a "$out/summary.tsv"
}

if [ "$size" = small ]; then
    knight=(--downscale 8 --set max_cap=500 --set iterations=50)
    # A run of a few hundred Gaussians in place of scenes A, B and C.
    part small 120 "$bin/splat4d" train examples/knight -o "$out/small" --force --device cpu --no-eval "${knight[@]}"
    scenes=(--scene T --file "$out/small" --rounds 1)
    one=("${scenes[@]}")
else
    knight=()
    scenes=()
    one=(--scene B)
fi

export REQUIRE_GPU=1
number=0
for test in ${TESTS:-}; do
    number=$((number + 1))
    part "tests-$number" 240 "$test" gpu::
done
part stages 240 "$bin/studies" bench --device gpu "${scenes[@]}" --save "$out/gpu.json"
part sweep 300 "$bin/studies" bench --device gpu --sweep "${one[@]}" --save "$out/sweep.json"
for device in gpu cpu; do
    part "knight-$device" 180 "$bin/splat4d" train examples/knight -o "$out/knight-$device" --force --device "$device" "${knight[@]}"
done
# In turns, so that clocks and other users of the card affect both programs alike.
part others-write 120 "$bin/studies" bench --device gpu "${scenes[@]}" --beside "$out/others"
for turn in 1 2; do
    part "gsplat-$turn" 300 "${PYTHON:-python3}" studies/other_programs/with_gsplat.py "$out"/others/*
    part "others-$turn" 120 "$bin/studies" bench --device gpu "${scenes[@]}" --beside "$out/others"
done
