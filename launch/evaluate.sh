#!/usr/bin/env bash
# Flies a snapshot through courses without exploration, and prints how far it got.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"

help_if_asked "$@" <<END
Usage: launch/evaluate.sh --run DIR | --snapshot FILE [--course FILE ...] [--flights N] [--json FILE] [--record FILE]

Flies a trained snapshot from the start of level 1, without exploration noise, and prints per course how many flights passed
each wall, the share R of walls passed, and how many courses were completed.

Options:
  --run DIR        evaluate the best snapshot of this run
  --snapshot FILE  evaluate this snapshot
  --course FILE    fly this course; may be repeated [default: all courses of the run's config]
  --flights N      flights per course [default: 100]
  --json FILE      write the table as JSON as well
  --record FILE    write every step (pose, velocity, depth image, latent, action, reward terms) for reading from Python
  -h, --help       this text

Exit status: 0 evaluated, 1 failed.
END

build
run_built skein-evaluate "$@"
