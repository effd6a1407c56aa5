#!/bin/sh
# A long capture on a Slurm cluster: one array job per wave, each waiting for the previous one. The folders are on a file system
# that all nodes share. Run it again after any failure: finished chunks are skipped.
#
#   sh slurm.sh CAPTURE RUN [options of `splat4d train`]
#   SBATCH_OPTIONS="--cpus-per-task=16 --mem=8G --time=4:00:00" sh slurm.sh ...
set -eu
capture=$1 run=$2
shift 2
splat4d=${SPLAT4D:-splat4d}
options=${SBATCH_OPTIONS:---cpus-per-task=1}

# The shared layer first: it determines the number of chunks, which the arrays need at submission.
"$splat4d" train "$capture" -o "$run" --chunk shared "$@"
last=$(python3 -c 'import json, sys; print(len(json.load(open(sys.argv[1]))["cuts"]))' "$run/chunks/plan.json")

# wave FIRST [more of sbatch]: chunks FIRST, FIRST + 2 ...; prints the job's number. Requeued if its node dies.
wave() {
    first=$1
    shift
    # shellcheck disable=SC2086
    sbatch --parsable --requeue --job-name=splat4d --array="$first-$last:2" --output="$run/slurm-%A_%a.log" $options "$@"
}
quoted() { for word; do printf "'%s' " "$(printf %s "$word" | sed "s/'/'\\\\''/g")"; done; }
train="$(quoted "$splat4d" train "$capture" -o "$run")--chunk \$SLURM_ARRAY_TASK_ID $(quoted "$@")"
even=$(wave 0 --wrap "$train")
odd=$(wave 1 --dependency="afterok:$even" --wrap "$train")
# shellcheck disable=SC2086
join=$(sbatch --parsable --job-name=splat4d-join --dependency="afterok:$odd" --output="$run/slurm-%j.log" $options \
    --wrap "$(quoted "$splat4d" join "$run" --no-eval)")
echo "even chunks: $even, odd ones: $odd, join: $join (squeue shows them)"
