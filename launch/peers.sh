#!/usr/bin/env bash
# Tries the Python package with the heavy packages that users train with.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

# PufferLib's emulation and vector environments as a wheel. PufferLib 3.0.0 itself refuses gymnasium 1.x, and downloads from GitHub
# as it is built. This one pins another PyTorch than the peers have, but steps environments with any.
readonly PUFFERLIB=pufferlib-core==3.0.23
# The simulator that --bench compares with. It is on no package index.
readonly DRONES=git+https://github.com/learnsyslab/gym-pybullet-drones@90b178aba69b09085dd70e7a1e88bb58ca00b4c9
# What it needs pinned: its physics, and the last setuptools with the pkg_resources that it imports.
readonly DRONES_NEEDS=(pybullet==3.2.7 setuptools==80.10.2)

help_if_asked -- "$@" <<END
launch/peers.sh [--bench] [--learn] sets up PyTorch, stable-baselines3, TorchRL, PufferLib, Minari, W&B, MLflow and Trackio (pinned,
7 GB) in an environment of their own, with the package skein-rl, and runs the tests that need them. The environment is
python/peers in cargo's target directory.

  --bench   then print steps a second of the vector environment, beside the simulator alone; and depth images a second, beside
            gym-pybullet-drones, which pip takes from GitHub (or from SKEIN_GYM_PYBULLET_DRONES, a folder or any other address
            for pip)
  --learn   then print steps and time that Skein, stable-baselines3 and a SAC in CleanRL's style take to R >= 0.9 on the same
            task, three seeds each (an hour on two cores); actor/python/benches/learning.py does a part of it

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

# pip of the environment, quiet unless it fails.
install() {
    "$venv/bin/python" -m pip --disable-pip-version-check --quiet install "$@" || {
        echo "peers.sh: pip failed; its messages above say why: check the network, pip's settings and the disk (8 GB)" >&2
        exit 1
    }
}

venv=$(target_directory)/python/peers
"$repository/launch/python.sh" --venv "$venv"
package=$repository/actor/python
install --requirement "$package/tests/requirements.txt" --requirement "$package/tests/peers.txt"
install --no-deps "$PUFFERLIB"
drones=${SKEIN_GYM_PYBULLET_DRONES:-$DRONES}
# The folder changes below.
[[ ! -d $drones ]] || drones=$(realpath -- "$drones")
# From the tests' folder, so that the installed package is what is tested.
cd "$package/tests"
"$venv/bin/python" -m pip --disable-pip-version-check list 2>/dev/null | grep -E '^(gymnasium|numpy|pufferlib|skein|stable|torch)'
SDL_VIDEODRIVER=dummy "$venv/bin/python" -m pytest -q -p no:cacheprovider test_peers.py test_policy.py test_data.py
if [[ $bench == yes ]]; then
    "$venv/bin/python" ../benches/vector.py
    install "${DRONES_NEEDS[@]}" "$drones"
    "$venv/bin/python" ../benches/pybullet_drones.py
fi
if [[ $learn == yes ]]; then
    build_training
    "$venv/bin/python" ../benches/learning.py --skein "$(target_directory)/release/skein"
fi
