#!/usr/bin/env bash
# Everything a change must pass: format, lints, the tests of all crates, among them whole runs with real processes, and that
# benchmarks run.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked -- "$@" <<END
launch/test.sh checks formatting and lints, builds everything, and runs all tests, in the release profile: what is tested is
what runs. Then it builds, installs and tests the Python package, and runs each benchmark for a moment, to see that it works; no
time is judged. At the end, or when something fails, it prints where the time went.

Exit status: 0 all passed, 1 something did not, 2 wrong arguments.
END

if (($# > 0)); then
    echo "test.sh: unknown argument \"$1\": see launch/test.sh --help" >&2
    exit 2
fi

# What has taken how many seconds so far, a line each; the step under way, and when it began.
spent='' step='' begun=0
tests=$(mktemp)

begin() {
    [[ -z $step ]] || spent+=$(printf '%6d s  %s' $((SECONDS - begun)) "$step")$'\n'
    step=$1 begun=$SECONDS
    printf '\n== %s\n' "${step:-where the time went}"
}

# Seconds of the tests of each package: its unit tests, then its other ones, as cargo runs them.
seconds_by_package() {
    awk '
        /^ *Running / {
            name = $NF
            gsub(/^.*\/|-[0-9a-f]*\)$/, "", name)
            gsub(/_/, "-", name)
            if (/ unittests /) package = name
        }
        /^test result: / {
            if (!(package in spent)) order[++count] = package
            spent[package] += $NF
        }
        END { for (i = 1; i <= count; i++) printf "%6.0f s    %s\n", spent[order[i]], order[i] }' "$tests"
}

report() {
    local status=$? last=$step
    begin ''
    printf '%s' "$spent"
    if [[ -s $tests ]]; then
        echo 'of the tests:'
        seconds_by_package
    fi
    printf '%6d s  all together\n' "$SECONDS"
    ((status == 0)) || echo "test.sh: FAILED: $last" >&2
    rm -f "$tests"
}
trap report EXIT

"$repository/launch/setup.sh"
cd "$repository"
begin format
cargo fmt --all --check
if command -v shellcheck >/dev/null; then
    shellcheck --external-sources --source-path=SCRIPTDIR launch/*.sh tests/*.sh
fi
begin lints
# In the profile of the tests: both share build scripts and macros. Examples are checked here alone.
cargo clippy --release --locked --workspace --all-targets -- -D warnings
# The whole-system tests start the built programs. Programs, tests and benchmarks are built with the same settings: each crate is
# compiled once, and once more with its own tests.
begin "build: programs"
cargo build --release --locked --workspace --bins
begin "build: tests"
# --tests leaves out examples, documentation comments (there are no tests in them) and programs without tests.
cargo test --release --locked --workspace --tests --no-run
begin tests
CARGO_TERM_COLOR=never cargo test --release --locked --workspace --tests 2>&1 | tee "$tests"
# The wheel in a fresh environment. Built alone, it has a build of its dependencies of its own.
begin "Python package, with its build"
"$repository/launch/python.sh" --test
# Every benchmark, the rare ones too.
begin "benchmarks, with their build"
"$repository/tests/bench.sh" --quick --growth
