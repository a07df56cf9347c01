#!/usr/bin/env bash
# Tries the Python package with the heavy packages that users train with.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked -- "$@" <<END
launch/peers.sh [--bench] [--learn] sets up PyTorch, stable-baselines3, TorchRL, Minari, W&B, MLflow and Trackio (pinned, 7 GB) in an environment
of their own, with the package skein-rl, and runs the tests that need them. The environment is python/peers in cargo's target directory.

  --bench   then print steps a second of the vector environment, beside the simulator alone
  --learn   then print steps and time that stable-baselines3, a SAC in CleanRL's style and Skein take to R >= 0.9 on the same task,
            three seeds each (hours on two cores); actor/python/benches/learning.py does a part of it

Exit status: 0 all passed, 1 something did not, 2 wrong arguments.
END

bench=no learn=no
while (($# > 0)); do
    case $1 in
        --bench) bench=yes && shift ;;
        --learn) learn=yes && shift ;;
        *) echo "peers.sh: unknown argument \"$1\": see launch/peers.sh --help" >&2; exit 2 ;;
    esac
done

venv=$(target_directory)/python/peers
"$repository/launch/python.sh" --venv "$venv"
package=$repository/actor/python
"$venv/bin/python" -m pip --disable-pip-version-check --quiet install \
    --requirement "$package/tests/requirements.txt" --requirement "$package/tests/peers.txt" || {
    echo "peers.sh: pip failed; its messages above say why: check the network, pip's settings and the disk (8 GB)" >&2
    exit 1
}
# From the tests' folder, so that the installed package is what is tested.
cd "$package/tests"
"$venv/bin/python" -m pip --disable-pip-version-check list 2>/dev/null | grep -E '^(gymnasium|numpy|skein|stable|torch)'
SDL_VIDEODRIVER=dummy "$venv/bin/python" -m pytest -q -p no:cacheprovider test_peers.py test_policy.py test_data.py
[[ $bench == no ]] || "$venv/bin/python" ../benches/vector.py
if [[ $learn == yes ]]; then
    build_training
    "$venv/bin/python" ../benches/learning.py --skein "$(target_directory)/release/skein"
fi
