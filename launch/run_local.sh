#!/usr/bin/env bash
# Trains on this machine: one learner and N actors, progress on the terminal, an evaluation table at the end.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein run -- "$@" <<END
launch/run_local.sh [--watch] [OPTIONS] builds Skein and runs "skein run" with these options. By default it
trains configs/local.toml in runs/<date>_<time>_<process>. With --watch it also serves the page of
launch/watch.sh, until the run ends.
END

arguments=()
watched=no
for argument in "$@"; do
    if [[ $argument == --watch ]]; then
        watched=yes
    else
        arguments+=("$argument")
    fi
done
# The process id tells apart two starts in one second.
run_directory=$repository/runs/$(date +%Y-%m-%d_%H-%M-%S)_$$
is_new=yes
previous=
for argument in ${arguments[@]+"${arguments[@]}"}; do
    case $argument in
        --resume | --resume=*) is_new=no ;;
    esac
    case $argument in
        --resume=* | --run-dir=*) run_directory=${argument#*=} ;;
    esac
    case $previous in
        --resume | --run-dir) run_directory=$argument ;;
    esac
    previous=$argument
done
if [[ $is_new == yes ]]; then
    arguments=(--config "$repository/configs/local.toml" --run-dir "$run_directory" ${arguments[@]+"${arguments[@]}"})
fi

build_training
if [[ $watched == yes ]]; then
    build_watch
    runs=$(dirname "$run_directory")
    mkdir -p "$runs"
    # The page's parent is this process, which becomes the run.
    page=$(target_directory)/release/skein-watch
    exec {address}< <(exec "$page" "$runs" --port 0 --end-with-parent)
    read -r -t 20 line <&"$address" || {
        echo "the page did not start; leave --watch out" >&2
        exit 1
    }
    exec {address}<&-
    echo "${line/Ctrl-C ends it/it ends with the run}"
fi
run_built skein run "${arguments[@]}"
