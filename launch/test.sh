#!/usr/bin/env bash
# Everything a change must pass: format, lints, and the tests of all crates, among them whole runs with real processes; and that benchmarks run.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"

help_if_asked "$@" <<END
Usage: launch/test.sh

Checks formatting and lints, builds everything, and runs all tests, in the release profile (what is tested is what runs). Then it
runs each benchmark for a moment, to see that it works; no time is judged.
Under 40 minutes on a fresh machine with two cores.

Exit status: 0 all passed, 1 something did not, 2 called wrongly.
END

if (($# > 0)); then
    echo "test.sh: unknown argument \"$1\": see launch/test.sh --help" >&2
    exit 2
fi

"$repository/launch/setup.sh"
cd "$repository"
cargo fmt --all --check
if command -v shellcheck >/dev/null; then
    shellcheck --external-sources --source-path=SCRIPTDIR launch/*.sh
fi
cargo clippy --release --locked --workspace --all-targets -- -D warnings
# The whole-system tests start the built programs.
cargo build --release --locked --workspace --bins
cargo test --release --locked --workspace
# Every benchmark, the rare ones too.
"$repository/launch/bench.sh" --quick --growth
