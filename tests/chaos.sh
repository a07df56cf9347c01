#!/usr/bin/env bash
# Trains once in peace and once under fire, and shows that it makes no difference.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"

help_if_asked "$@" <<END
Usage: launch/chaos.sh [--config FILE] [--set section.key=value ...] [--seed N] [--actors N] [--run-dir DIR] [what to do]
       launch/chaos.sh --calm DIR [...]
       launch/chaos.sh --points [...]
       launch/chaos.sh --soak MINUTES [...]
       launch/chaos.sh --cost TIMES [...]

Trains the configuration undisturbed, then once more while it kills, freezes, attaches and takes away the run's processes at random
moments, and compares what was learned, bit for bit: policy, episodes, best snapshot, evaluation, curves. Then it looks for what is
left of the run on the machine. Everything that was done is in DIR/disturbances.jsonl; the same seed does the same.

Options:
  --config FILE            what to train and how [default: configs/smoke.toml]
  --set section.key=value  change one setting of the config; may be repeated
  --calm DIR               compare with this finished run and train by its configuration, instead of training in peace first
  --run-dir DIR            where everything goes; must be new or empty [default: runs/chaos_<date>_<time>]
  --seed N                 what is done, and when, follows from it [default: 1]
  --actors N               actors to start [default: 4]
  --actor-kills N          actors to kill with SIGKILL [default: 50]
  --learner-kills N        learners to kill [default: 5]
  --supervisor-kills N     supervisors to kill, every other one with all other processes at once; the run is resumed [default: 2]
  --freezes N              processes to stop and to continue later, half of them later than is put up with [default: 6]
  --attachments N          times to attach one or two actors and to take them away again [default: 3]
  --points                 instead of all that, let a process die at each of the points that are named in protocol/src/fault.rs
  --soak MINUTES           instead of all that, train for so long with actors coming and going, sample what every process holds
                           (DIR/soak.csv), and look for anything that grows
  --cost TIMES             instead of all that, train so many times with checkpoints and so many times without, in turn, and tell what
                           checkpoints and assembling episodes cost; on a machine that does nothing else
  -h, --help               this text

Exit status: 0 everything was done, nothing differs, grew, is left or costs 3 %; 1 otherwise; 2 called wrongly.
END

# --calm brings its own configuration.
config=(--config "$repository/configs/smoke.toml")
for argument in "$@"; do
    if [[ $argument == --calm || $argument == --calm=* ]]; then
        config=()
    fi
done

build
run_built skein-chaos "${config[@]}" --run-dir "$repository/runs/chaos_$(date +%Y-%m-%d_%H-%M-%S)" "$@"
