#!/usr/bin/env bash
# Makes the runs of Fig. 8 in docs/protocol.md, one after the other, and continues those that were interrupted.
# Usage: scripts/paper_runs.sh FOLDER [SEED ...]
set -euo pipefail
folder=${1:?name the folder of the runs}
seeds=("${@:2}")
[ ${#seeds[@]} -gt 0 ] || seeds=(20 21 22 23 24)
for algorithm in ${ALGORITHMS:-bgpo-paper maml-paper dist-nll-paper}; do
    for seed in "${seeds[@]}"; do
        python -m bgpo_trl continual --algorithm "$algorithm" --preset paper --seeds "$seed" \
            --eval-every 200 --eval-episodes 10 --held-out test \
            --resume --out "$folder/fig8-$algorithm-$seed"
    done
done
