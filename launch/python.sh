#!/usr/bin/env bash
# Builds the Python packages skein-rl and skein-rl-actor and installs them.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

# The tool that builds the wheel, in an environment of its own.
readonly MATURIN=maturin==1.16.0
# Largest wheel of each package, MB.
readonly LARGEST_MB=15
# Random calls of the fuzz test.
readonly FUZZ_CALLS=20000

help_if_asked -- "$@" <<END
launch/python.sh [--venv DIR] [--test] builds the wheels of the Python packages skein-rl and skein-rl-actor and installs them into a virtual
environment. The second holds what joins a run: skein_rl.Actor.

  --venv DIR   the environment; it is created if it does not exist [default: python/venv in cargo's target directory]
  --test       create a fresh environment beside it, then check types, run the package's tests and a short fuzz in it

The wheels go to python/wheels in cargo's target directory. You need python3 from 3.10 on, with pip and venv, and a network for
pip. libtorch is not needed.

Exit status: 0 installed, 1 failed, 2 wrong arguments.
END

venv='' test=no
while (($# > 0)); do
    case $1 in
        --venv)
            [[ -n ${2-} ]] || { echo "python.sh: --venv needs a directory: see launch/python.sh --help" >&2; exit 2; }
            venv=$(realpath --canonicalize-missing -- "$2")
            shift 2
            ;;
        --test) test=yes && shift ;;
        *) echo "python.sh: unknown argument \"$1\": see launch/python.sh --help" >&2; exit 2 ;;
    esac
done

fail() {
    printf 'python.sh: %s\n' "$*" >&2
    exit 1
}

check_python() {
    command -v python3 >/dev/null ||
        fail "python3 is missing: install it, on Debian or Ubuntu with: sudo apt install python3 python3-pip python3-venv"
    python3 -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
        fail "$(command -v python3) is $(python3 --version): the package needs Python 3.10 or later"
    python3 -c 'import ensurepip, venv' 2>/dev/null ||
        fail "python3 has no venv: install it, on Debian or Ubuntu with: sudo apt install python3-venv"
}

# pip of an environment, quiet unless it fails.
pip_of() {
    local environment=$1
    shift
    "$environment/bin/python" -m pip --disable-pip-version-check --quiet "$@" ||
        fail "pip $1 failed in $environment; its messages above say why: check the network and pip's settings, then run again"
}

create() {
    [[ -x $1/bin/python ]] || python3 -m venv "$1" || fail "cannot create a virtual environment in $1"
}

# Builds the wheel of a package into a folder of its own; $wheels gets its path too. Cargo gets the settings of .cargo/config.toml
# from the repository. The variable tells PyO3 not to link libpython, which the interpreter that loads the package brings.
build_wheel() {
    local package=$1 about=$2 built=$work/wheels/$(basename "$1") wheel
    create "$work/build"
    [[ -x $work/build/bin/maturin ]] || pip_of "$work/build" install "$MATURIN"
    rm -rf "$built"
    (cd "$repository" && PYO3_BUILD_EXTENSION_MODULE=1 "$work/build/bin/maturin" build --release --locked \
        --manifest-path "$package/Cargo.toml" --out "$built" --interpreter "$work/build/bin/python" 2>&1) |
        say_once "building the wheel $about" >&2 ||
        fail "the build failed; maturin's messages above say why"
    wheel=$(find "$built" -name '*.whl')
    [[ $(stat -c %s "$wheel") -le $((LARGEST_MB * 1000000)) ]] ||
        fail "$wheel has $(stat -c %s "$wheel") bytes, more than $LARGEST_MB MB: look for what made it grow"
    wheels+=("$wheel")
}

run_tests() {
    local tests=$repository/actor/python/tests program
    pip_of "$venv" install --requirement "$tests/requirements.txt"
    program=$target/release/skein-evaluate
    [[ ! -x $program ]] || export SKEIN_EVALUATE=$program
    [[ ! -x $target/release/skein-learner ]] || export SKEIN=$target/release/skein
    # From the tests' folder, so that the installed package is what is tested.
    cd "$tests"
    "$venv/bin/python" -m mypy --config-file ../pyproject.toml --package skein_rl
    SDL_VIDEODRIVER=dummy "$venv/bin/python" -m pytest -q -p no:cacheprovider .
    "$venv/bin/python" fuzz.py "$FUZZ_CALLS"
}

check_python
target=$(target_directory)
work=$target/python
venv=${venv:-$work/venv}
mkdir -p "$work"
wheels=()
build_wheel actor/python "skein-rl (about 2 minutes on two cores the first time)"
build_wheel actor/python/actor "skein-rl-actor (about a minute more)"
[[ $test == no ]] || rm -rf "$work/test"
[[ $test == no ]] || venv=$work/test
create "$venv"
pip_of "$venv" install --force-reinstall --no-deps "${wheels[@]}"
pip_of "$venv" install "${wheels[@]}"
[[ $test == no ]] || run_tests
[[ $test == yes ]] || echo "skein-rl is installed: $venv/bin/python -c 'import skein_rl'"
