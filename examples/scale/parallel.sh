#!/bin/sh
# A long take with GNU parallel: JOBS workers at once, on this machine or, with --sshlogin in PARALLEL's options, on others
# that see the same folders. Run it again after whatever went wrong: what is done is not done twice.
#
#   sh parallel.sh CAPTURE RUN JOBS [options of `splat4d train`]
set -eu
capture=$1 run=$2 jobs=$3
shift 3
splat4d=${SPLAT4D:-splat4d}

part() { "$splat4d" train "$capture" -o "$run" --chunk "$@"; }
part shared "$@"
# The plan states where the take is cut: one chunk more than there are cuts.
chunks=$(python3 -c 'import json, sys; print(len(json.load(open(sys.argv[1]))["cuts"]) + 1)' "$run/chunks/plan.json")
for first in 0 1; do # even chunks, then odd ones
    seq "$first" 2 $((chunks - 1)) |
        parallel --jobs "$jobs" --halt soon,fail=1 "$splat4d" train "$capture" -o "$run" --chunk {} "$@"
done
"$splat4d" join "$run"
