#!/usr/bin/env bash
# Throws bytes at everything that reads bytes from outside, for as long as wanted, following what code they reach.
set -euo pipefail
# shellcheck source=../launch/common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../launch/common.sh"

help_if_asked -- "$@" <<END
Usage: tests/fuzz.sh [SECONDS | --executions N] [--target NAME ...] [--jobs N]

Drives every fuzz target of tests/fuzz for SECONDS each [default: 60], or until each has done its share of N executions in all (slow
ones a smaller one), and prints for each its executions, how many edges of the code it reached, and what it found.

The first build takes as long as that of the whole project: all of it is built again with counters, into target/fuzz.
Ten million executions take some 20 minutes on two cores. What is reached is kept in target/fuzz/corpus, where the next run goes on.

Options:
  --executions N  executions over all targets
  --target NAME   drive this target only; may be repeated
  --jobs N        targets driven at one time [default: one a core]
  -h, --help      this text

Exit status: 0 nothing was found, 1 something was, or the targets could not be driven, 2 wrong arguments.
END

fail() {
    echo "fuzz.sh: $1: see tests/fuzz.sh --help" >&2
    exit 2
}

# Prints the value of an option that must be a positive number.
number() {
    [[ ${2:-} =~ ^[1-9][0-9]*$ ]] || fail "$1 takes a number above 0"
    echo "$2"
}

seconds=60 executions='' jobs=$(nproc) chosen=()
while (($# > 0)); do
    case $1 in
    --executions) executions=$(number "$1" "${2:-}") && shift ;;
    --jobs) jobs=$(number "$1" "${2:-}") && shift ;;
    --target) chosen+=("${2:?--target takes a name}") && shift ;;
    -*) fail "unknown argument \"$1\"" ;;
    *) seconds=$(number SECONDS "$1") ;;
    esac
    shift
done

"$repository/launch/setup.sh"
cd "$repository"
readonly platform=x86_64-unknown-linux-gnu work=$repository/target/fuzz
# What -Zsanitizer would set up on the nightly toolchain, without an address sanitizer: counters on edges, and what is compared with what.
# Wrapped arithmetic is a finding too. With --target, the flags do not reach build scripts, which could not be linked with them.
flags=(-Cpasses=sancov-module -Coverflow-checks=yes)
for option in level=4 inline-8bit-counters pc-table trace-compares; do
    flags+=("-Cllvm-args=-sanitizer-coverage-$option")
done
RUSTFLAGS="${flags[*]}" CARGO_INCREMENTAL=0 cargo build --release --locked --target "$platform" --target-dir "$work" \
    --package skein-fuzz --features coverage --bin skein-fuzz
readonly program=$work/$platform/release/skein-fuzz

mapfile -t targets < <("$program" | while IFS=$'\t' read -r name longest weight _; do
    ((${#chosen[@]} == 0)) || [[ " ${chosen[*]} " == *" $name "* ]] || continue
    echo "$name $longest $weight"
done)
((${#targets[@]} > 0)) || fail "no target is called ${chosen[*]}"
weights=$(printf '%s\n' "${targets[@]}" | awk '{ sum += $3 } END { print sum }')
mkdir -p "$work/findings" "$work/logs"
# Readers of files read them from memory.
TMPDIR=$(mktemp --directory --tmpdir=/dev/shm skein-fuzz-XXXXXX)
trap 'rm -rf "$TMPDIR"' EXIT

# Drives one target and prints its line of the table.
drive() {
    local name=$1 longest=$2 weight=$3 log=$work/logs/$1.log found limit=-max_total_time=$seconds
    [[ -z $executions ]] || limit=-runs=$((executions * weight / weights + 1))
    mkdir -p "$work/corpus/$name"
    SKEIN_FUZZ_TARGET=$name "$program" "$work/corpus/$name" "$limit" -max_len="$longest" -timeout=10 -rss_limit_mb=4096 \
        -print_final_stats=1 -artifact_prefix="$work/findings/$name-" >"$log" 2>&1 && found=none || found="see $log"
    awk -v name="$name" -v found="$found" '
        match($0, /cov: [0-9]+/) { edges = substr($0, RSTART + 5, RLENGTH - 5) }
        /stat::number_of_executed_units/ { done = $2 }
        /stat::average_exec_per_sec/ { rate = $2 }
        END { printf "%-20s %12d %10d %8d  %s\n", name, done, rate, edges, found }' "$log"
    [[ $found == none ]]
}
export -f drive
export work program seconds executions weights TMPDIR

printf '%-20s %12s %10s %8s  %s\n' target executions 'a second' edges findings
printf '%s\n' "${targets[@]}" | xargs -P "$jobs" -L 1 bash -c 'drive "$@"' drive || {
    echo
    echo "A finding is a file in $work/findings. See it again with"
    echo "  SKEIN_FUZZ_TARGET=NAME $program FILE"
    echo "and, once it is understood, keep it in tests/fuzz/regressions/NAME: the test suite reads it from then on."
    exit 1
}
