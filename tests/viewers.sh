#!/usr/bin/env bash
# Opens what Skein writes in what people look at it with: MCAP's own reader, Rerun, TensorBoard, and the page in Chromium.
set -euo pipefail
# shellcheck source=../launch/common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../launch/common.sh"

# Too large for launch/test.sh.
readonly RERUN=rerun-sdk==0.41.0

help_if_asked -- "$@" <<END
tests/viewers.sh [--page] [--shots FOLDER] [RUNS] builds Skein and the package skein-rl, installs it with TensorBoard, mcap and
Rerun (pinned) into an environment of their own, python/viewers in cargo's target directory, and checks that

  - the package mcap reads every value of a recording as the .npz has it
  - Rerun takes the MCAP as it is, and what skein_rl.rerun writes
  - TensorBoard reads curves, pictures, settings and text of a run
  - every view of the page of skein watch is drawn in a headless Chromium, and a run is followed to its end, without an error:
    tests/page.py

  RUNS            folder of runs that the page shows [default: a short run, made for it]
  --shots FOLDER  keep pictures of the views there
  --page          fail where there is no Chromium; without it, the page is left out with a line that says so

Exit status: 0 all passed, 1 something did not, 2 wrong arguments.
END

page=if-there shots=() follow=() runs=''
while (($# > 0)); do
    case $1 in
        --page) page=always && shift ;;
        --shots)
            [[ -n ${2-} ]] || { echo "viewers.sh: --shots needs a folder: see tests/viewers.sh --help" >&2; exit 2; }
            shots=(--shots "$2")
            shift 2
            ;;
        -*) echo "viewers.sh: unknown argument \"$1\": see tests/viewers.sh --help" >&2; exit 2 ;;
        *) runs=$(realpath -- "$1") && shift ;;
    esac
done

build_training
build_evaluation
build_watch
target=$(target_directory)
venv=$target/python/viewers
"$repository/launch/python.sh" --venv "$venv"
tests=$repository/actor/python/tests
"$venv/bin/python" -m pip --disable-pip-version-check --quiet install --requirement "$tests/requirements.txt" "$RERUN" || {
    echo "viewers.sh: pip failed; its messages above say why: check the network, pip's settings and the disk" >&2
    exit 1
}
export SKEIN_EVALUATE=$target/release/skein-evaluate SKEIN=$target/release/skein
# From the tests' folder, so that the installed package is what is tested. Rerun's program lies in the environment.
(cd "$tests" && PATH=$venv/bin:$PATH "$venv/bin/python" -m pytest -q -p no:cacheprovider test_viewers.py test_data.py)

if [[ -z $runs ]]; then
    runs=$(mktemp -d)
    trap 'rm -rf "$runs"' EXIT
    "$SKEIN" run --config "$repository/tests/small.toml" --run-dir "$runs/short" --set run.record_every=10 >"$runs/log" 2>&1 || {
        cat "$runs/log" >&2
        exit 1
    }
    # Another trains while the page shows it, and ends there.
    "$SKEIN" run --config "$repository/tests/small.toml" --run-dir "$runs/followed" --set run.episodes=400 >"$runs/log" 2>&1 &
    trap 'kill %% 2>/dev/null; rm -rf "$runs"' EXIT
    follow=(--follow followed)
fi
status=0
SKEIN_WATCH=$target/release/skein-watch "$venv/bin/python" "$repository/tests/page.py" ${shots[@]+"${shots[@]}"} ${follow[@]+"${follow[@]}"} "$runs" || status=$?
[[ $status != 77 || $page == always ]] || status=0
((status == 0)) || exit 1
