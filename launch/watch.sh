#!/usr/bin/env bash
# Serves a page on this machine that shows what the runs of a folder are doing.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein-watch -- "$@" <<END
launch/watch.sh [OPTIONS] [DIR] builds what the page needs and runs "skein-watch" with these options.
By default it shows the runs in runs/.
END

build_watch
if (($# == 0)); then
    mkdir -p "$repository/runs"
    set -- "$repository/runs"
fi
run_built skein-watch "$@"
