#!/usr/bin/env bash
# Flies a snapshot through courses without exploration, and prints how far it got.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"

help_if_asked "$@" <<END
Usage: launch/evaluate.sh --run DIR | --snapshot FILE [--course FILE ... | --suite FILE] [--episodes N] [--json FILE] [--record FILE] [--threads N]

Flies a trained snapshot from the start of level 1, without exploration noise, and prints per course how many episodes passed
each wall, the share R of walls passed, how many courses were completed, and what the other episodes failed by.

Options:
  --run DIR        evaluate the best snapshot of this run (the latest, if none was confirmed as best)
  --snapshot FILE  evaluate this snapshot
  --course FILE    fly this course; may be repeated [default: the evaluation courses of the snapshot's run]
  --suite FILE     fly this suite of courses and disturbances, as configs/evaluations/generalist.toml
  --episodes N      episodes per course or entry [default: evaluation.episodes of that run, 100 as shipped, or what the suite says]
  --json FILE      write the table as JSON as well
  --record FILE    write every step (pose, velocity, depth image, latent, action, reward terms) as .npz, for numpy; held in memory until then,
                   some megabyte an episode
  --threads N      threads to fly on; the result does not depend on it [default: one a core]
  -h, --help       this text

Exit status: 0 evaluated, 1 failed, 2 wrong call.
END

build
run_built skein-evaluate "$@"
