#!/usr/bin/env bash
# Measures every stage of the data's way against its baseline, and prints one table.
set -euo pipefail
# shellcheck source=../launch/common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../launch/common.sh"

help_if_asked -- "$@" <<END
Usage: tests/bench.sh [--quick] [--only NAME ...] [--growth]

Builds Skein and its benchmarks, runs them one after the other, and prints what they measured: figure, what it must reach, baseline,
ratio, and the machine. Figures and their baselines are measured by the same run; what is meant for one core runs on one. Less than
10 minutes beyond the build, on a machine that should do nothing else meanwhile.

Options:
  --quick       a fraction of a second for each, to see that they work: no time is judged, and results lie in target/bench-quick/
  --only NAME   this benchmark alone; may be repeated. tests/bench/benchmarks.toml names them. sac_peer runs only if it is named: it
                compares with JAX, which it installs into target/bench-python/ (630 MB)
  --growth      measure as well how cost grows with the episodes of an epoch, and draw all growth into docs/pictures/
  -h, --help    this text

What was measured lies in target/bench/: table.md, table.json, criterion's samples, and what each benchmark printed.

Exit status: 0 everything was measured, 1 a benchmark failed or did not print a figure that tests/bench/benchmarks.toml asks for, 2 wrong arguments.
END

# Rows and pictures have no `name`.
known=$(sed -n 's/^name = "\(.*\)"$/\1/p' "$repository/tests/bench/benchmarks.toml")
quick='' growth='' only=()
while (($# > 0)); do
    case $1 in
    --quick) quick=--quick ;;
    --growth) growth=--growth ;;
    --only)
        (($# > 1)) || {
            echo "bench.sh: --only takes a name: see tests/bench.sh --help" >&2
            exit 2
        }
        grep -qxF "$2" <<<"$known" || {
            echo "bench.sh: no benchmark is called \"$2\"; there are $(paste -sd ' ' <<<"$known")" >&2
            exit 2
        }
        only+=(--only "$2") && shift
        ;;
    *)
        echo "bench.sh: unknown argument \"$1\": see tests/bench.sh --help" >&2
        exit 2
        ;;
    esac
    shift
done

build
cd "$repository"
target=$(target_directory)
benches=$("$target/release/skein-bench" list ${growth:+"$growth"} "${only[@]}")
# A trial leaves what was measured before where it is.
readonly results=$target/bench${quick:+-quick}
rm -rf "$results"
mkdir -p "$results"
export CRITERION_HOME=$results/criterion

# Criterion's own settings: long enough for a median that holds still, short enough for the whole table.
timing=(--warm-up-time 0.5 --measurement-time 3 --sample-size 60 --nresamples 10000)
[[ -z $quick ]] || timing=(--warm-up-time 0.05 --measurement-time 0.1 --sample-size 10 --nresamples 1000)

# The last core that this shell may use: the first often serves the system's interrupts.
pin=()
if command -v taskset >/dev/null; then
    pin=(taskset --cpu-list "$(taskset --cpu-list --pid $$ | grep -o '[0-9]*$')")
else
    echo "bench.sh: taskset (util-linux) is missing: nothing is pinned to a core, and times scatter" >&2
fi

if grep -q '^sac_peer ' <<<"$benches"; then
    python=$target/bench-python
    [[ -x $python/bin/python ]] || python3 -m venv "$python"
    "$python/bin/pip" install --quiet --disable-pip-version-check jax==0.10.2 optax==0.2.8
    export SKEIN_PEER_PYTHON=$python/bin/python
fi

named=()
while read -r name _; do
    named+=(--bench "$name")
done <<<"$benches"
cargo bench --locked --workspace --no-run "${named[@]}"

while read -r name kind; do
    started=$SECONDS
    "${pin[@]}" "$target/release/skein-bench" core >>"$results/machine.jsonl"
    run=(cargo bench --quiet --locked --workspace --bench "$name" --)
    case $kind in
    one-core) run=("${pin[@]}" "${run[@]}" --noplot "${timing[@]}") ;;
    processes) run+=(${quick:+"$quick"}) ;;
    esac
    "${run[@]}" >"$results/$name.figures" 2>"$results/$name.log" </dev/null || {
        tail -n 20 "$results/$name.figures" "$results/$name.log" >&2
        echo "bench.sh: the benchmark $name failed" >&2
        exit 1
    }
    printf '%-20s measured in %d s\n' "$name" $((SECONDS - started))
done <<<"$benches"

# Times of a trial mean nothing: their pictures do not belong into the documents.
pictures=$repository/docs/pictures
[[ -z $quick ]] || pictures=$results
"${pin[@]}" "$target/release/skein-bench" table "$results" ${quick:+"$quick"} ${growth:+--pictures "$pictures"} "${only[@]}"
