#!/usr/bin/env bash
# Measures what being watched and being recorded cost a training, and how the page bears many runs.
set -euo pipefail
# shellcheck source=../launch/common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../launch/common.sh"

help_if_asked -- "$@" <<END
Usage: tests/watched.sh [ROUNDS]

Trains 120 episodes of configs/generalist.toml in each way of ROUNDS rounds (4):

  plain     as it is
  watched   while a reader asks the page's server each second for all that the page shows
  shown     while headless Chromium shows the page on the same machine, if it is installed
  recorded  with every training episode recorded (run.record_every=1)

Prints seconds of each: on the clock, of the processor for the run, and of the processor for the page's server; then medians over
the rounds of the first two, divided by the plain way's of the same round. On a virtual machine both scatter by a tenth. About 40
seconds a training on two cores, which should do nothing else. Every way must end with the same policy. Then copies of a run, 50
with 20,000 episodes and one with 1,000,000, are listed, described and drawn: seconds of each answer, and the server's memory.

Exit status: 0 all policies are equal, 1 something failed or differs, 2 wrong arguments.
END
[[ ${1-4} =~ ^[1-9][0-9]*$ && $# -le 1 ]] || {
    echo "watched.sh: \"$*\" is no number of rounds: see tests/watched.sh --help" >&2
    exit 2
}

# Asks each second for all that a page shows of a run: curves, settings, actors, the newest episodes.
read_page() {
    local api=$1/api run=$2
    while true; do
        curl -s -m 5 "$api/runs" "$api/run?run=$run" "$api/curves?curve=return&run=$run" "$api/flights?run=$run" \
            "$api/recordings?run=$run" >/dev/null || true
        sleep 1
    done
}

# Starts the page's server over a folder; leaves its process and address in $server and $address.
serve() {
    local line
    exec {page}< <(exec "$programs/skein-watch" "$1" --port 0 --end-with-parent)
    server=$!
    read -r -t 20 line <&"$page"
    address=$(grep -o 'http://[0-9.:]*' <<<"$line")
}

train() {
    local run=$1 way=$2 settings=() watchers=() times served=0 server address
    local TIMEFORMAT='%R %U %S'
    [[ $way != recorded ]] || settings=(--set run.record_every=1)
    if [[ $way == watched || $way == shown ]]; then
        serve "$runs"
        watchers=("$server")
        if [[ $way == watched ]]; then
            read_page "$address" "$run" &
        else
            chromium --headless=new --no-sandbox --disable-gpu --disable-background-networking --no-first-run \
                --user-data-dir="$runs/.browser" --remote-debugging-port=0 "$address" >/dev/null 2>&1 &
        fi
        watchers+=($!)
    fi
    times=$({ time "$programs/skein" run --config "$repository/configs/generalist.toml" --run-dir "$runs/$run" --actors 1 \
        --set run.episodes=120 --set evaluation.every_episodes=1000 --set evaluation.episodes=1 \
        ${settings[@]+"${settings[@]}"} >"$runs/$run.log" 2>&1; } 2>&1)
    if ((${#watchers[@]} > 0)); then
        served=$(awk -v ticks="$(getconf CLK_TCK)" '{ print ($14 + $15) / ticks }' "/proc/$server/stat")
        kill "${watchers[@]}" && exec {page}<&-
    fi
    wait
    awk -v way="$way" -v served="$served" -v policy="$(policy_of "$run")" '{
        printf "%-8s %6.2f s, of the processor %6.2f s and the page\x27s server %4.2f s, policy %.16s\n", way, $1, $2 + $3, served, policy
    }' <<<"$times" | tee -a "$runs/times"
}

policy_of() {
    sed -n 's/.*"policy_sha256": *"\([0-9a-f]*\)".*/\1/p' "$runs/$1/summary.json"
}

# Median over the rounds of a column of $runs/times, divided by the plain way's in the same round.
median_ratio() {
    awk -v way="$1" -v column="$2" '$1 == "plain" { plain = $column } $1 == way { print $column / plain }' "$runs/times" |
        sort -n | awk '{ all[NR] = $1 } END { printf "%.3f", (all[int((NR + 1) / 2)] + all[int(NR / 2) + 1]) / 2 }'
}

# Copies a run into another folder, its episodes repeated until there are so many.
copy_run() {
    local run=$1 copy=$2 episodes=$3
    mkdir -p "$(dirname "$copy")" && cp -r "$run" "$copy"
    awk -v episodes="$episodes" 'NR == 1 { print; next } { sub(/^[0-9]*/, ""); rows[NR - 2] = $0 }
        END { for (row = 0; row < episodes; row++) print row rows[row % (NR - 1)] }' "$run/episodes.csv" >"$copy/episodes.csv"
}

bear_many() {
    local many=$runs/many number what server address
    for ((number = 1; number <= 50; number++)); do
        copy_run "$runs/plain-1" "$many/run-$number" 20000
    done
    copy_run "$runs/plain-1" "$many/long" 1000000
    serve "$many"
    for what in runs runs run?run=long "curves?curve=return&run=long" "curves?curve=return&run=long"; do
        printf '%-28s ' "$what"
        curl -s -m 60 -o "$runs/answer" -w '%{time_total} s, %{size_download} bytes, status %{http_code}\n' "$address/api/$what"
    done
    awk '/VmHWM/ { printf "memory                       %.0f MB at most\n", $2 / 1000 }' "/proc/$server/status"
    kill "$server" && exec {page}<&-
}

build_training
build_watch
programs=$(target_directory)/release
runs=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; rm -rf "$runs"' EXIT
ways=(plain watched shown recorded)
command -v chromium >/dev/null || { echo "no chromium: the way \"shown\" is left out" && ways=(plain watched recorded); }
for ((round = 1; round <= ${1-4}; round++)); do
    for way in "${ways[@]}"; do
        train "$way-$round" "$way"
    done
done
bear_many
echo "beside plain, medians: time on the clock, processor's time"
for way in "${ways[@]:1}"; do
    echo "$way $(median_ratio "$way" 2) $(median_ratio "$way" 7)"
done
[[ $(awk '{ print $NF }' "$runs/times" | sort -u | wc -l) == 1 ]] || { echo "watched.sh: the policies differ" >&2 && exit 1; }
