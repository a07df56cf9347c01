#!/usr/bin/env bash
# Runs one of the experiments of configs/experiments/ with several seeds, and tells what it found.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"

help_if_asked "$@" <<END
Usage: launch/experiment.sh NAME [--seeds K] [--jobs J] [--episodes N] [--runs DIR] [--publish]
       launch/experiment.sh NAME --report [...]
       launch/experiment.sh --list

Builds Skein and trains every arm of the experiment configs/experiments/NAME.toml with several seeds: ordinary runs in
runs/experiments/NAME/ARM/seed-N, side by side, one core each. Then tells what they came to, in tables and pictures with 95 %
intervals over the seeds, in runs/experiments/NAME/report/. The same command goes on with what was interrupted or failed, and
leaves alone what is complete. What another experiment has trained with the same configuration and seed is not trained again: a
link leads there. What a run says goes to ARM/seed-N.log. If the experiment names an evaluation suite, the best snapshot of every
run flies it once the run is trained; the run is complete only then.

Options:
  --list       print the experiments, how many runs each is, and what it is to find out
  --seeds K    runs of each arm, with seeds 1 to K [default: what the experiment's file says]
  --jobs J     runs at a time [default: number of cores]
  --episodes N  shorten every run to N training episodes, in a place of their own: runs/experiments/NAME_N_episodes
  --runs DIR   where the runs of all experiments go [default: runs/experiments]
  --report     run nothing: tell again what is there
  --publish    put the report into RESULTS.md, between <!-- experiment: NAME --> and <!-- end -->, and its pictures and the
               figures of each run into launch/pictures/experiments/
  -h, --help   this text

Ctrl-C stops in order: every training under way finishes the updates of its epoch and saves; a suite under way is flown anew
the next time. A second Ctrl-C stops at once.

Exit status: 0 every run is complete, 1 a run failed or something was refused, 2 called wrongly, 130 interrupted.
END

build
run_built skein-experiment --repository "$repository" "$@"
