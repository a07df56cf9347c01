#!/usr/bin/env bash
# Puts libtorch into .libtorch/ in this repository, from three pinned wheels on PyPI.
#
# PyTorch's own download site is not reachable from everywhere, and the full Python package drags in 4.8 GB of CUDA libraries.
# So only what the learner links against is unpacked: headers, the CPU libraries, and the two CUDA libraries that the CPU
# library names but never calls without a GPU. Everything is built aside and moved into place at once: an interrupted run
# leaves nothing that a later one could mistake for a finished one.
set -euo pipefail

readonly TORCH_VERSION=2.13.0
# What stands in .libtorch/build-version. torch-sys compares the part before the "+"; raise the last number when the list of
# unpacked files changes.
readonly BUILD_VERSION="$TORCH_VERSION+cpu.1"
# Download (540 MB, twice for a moment while pip moves it) and unpacked files (490 MB).
readonly NEEDED_MB=1700
# For a download, one's own or somebody else's: enough at 0.3 MB/s.
readonly LONGEST_WAIT_SECS=1800

# With it, cd may go elsewhere and prints where it went.
unset CDPATH
repository=$(cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.." && pwd -P)
readonly repository
readonly target="$repository/.libtorch"
work=

usage() {
    cat <<END
Usage: launch/setup.sh [--help]

Prepares what building Skein needs beyond cargo: libtorch $TORCH_VERSION (CPU), from three pinned and hashed wheels on PyPI
(540 MB), unpacked to .libtorch/ in this repository. Nothing outside the repository is changed. A second run does nothing and
needs no network. The other scripts call this one.

Environment:
  LIBTORCH   your own libtorch $TORCH_VERSION (a CUDA build, say): it is used, and nothing is downloaded

Exit status: 0 libtorch is there, 1 failed, 2 wrong arguments.
END
}

fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}

# A terminal or reader that is gone must not end the set-up.
say() {
    (trap '' PIPE && exec 3>&2 2>/dev/null && printf 'setup: %s\n' "$*" >&3) || true
}

remove_work() {
    [[ -z $work ]] || rm -rf "$work"
}

check_tools() {
    command -v cargo >/dev/null ||
        fail "cargo is missing: install Rust from https://rustup.rs, then open a new shell"
    command -v c++ >/dev/null ||
        fail "no C++ compiler (c++): install one, on Debian or Ubuntu with: sudo apt install g++"
}

use_own_libtorch() {
    [[ -f $LIBTORCH/lib/libtorch_cpu.so && -d $LIBTORCH/include ]] ||
        fail "LIBTORCH=$LIBTORCH holds no include/ and lib/libtorch_cpu.so: correct it, or unset LIBTORCH to have libtorch fetched"
}

is_complete() {
    [[ -f $target/build-version && $(<"$target/build-version") == "$BUILD_VERSION" ]]
}

check_download_is_possible() {
    [[ $(uname -s)-$(uname -m) == Linux-x86_64 ]] ||
        fail "libtorch is fetched for Linux on x86_64 only, this is $(uname -s) on $(uname -m): set LIBTORCH to your own libtorch $TORCH_VERSION"
    command -v python3 >/dev/null ||
        fail "python3 is missing: install it, on Debian or Ubuntu with: sudo apt install python3 python3-pip"
    python3 -m pip --version >/dev/null 2>&1 ||
        fail "pip is missing for $(command -v python3): install it, on Debian or Ubuntu with: sudo apt install python3-pip"
    local free_mb
    free_mb=$(df -Pm "$repository" | awk 'NR == 2 { print $4 }')
    ((free_mb >= NEEDED_MB)) ||
        fail "only $free_mb MB free on the file system of $repository: free $((NEEDED_MB - free_mb)) MB more"
}

# The hashes pin one file each, so the tags are fixed as well: the user's own Python version must not choose another wheel.
download() {
    cat >"$work/requirements.txt" <<END
torch==$TORCH_VERSION --hash=sha256:60fcdcb2f3876e21146cb4524ef06397d727ca9ad5f020818547e25075fe3cb7
nvidia-cuda-runtime==13.0.96 --hash=sha256:7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548
nvidia-cuda-cupti==13.0.85 --hash=sha256:4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8
END
    mkdir "$work/tmp"
    # Errors are held in memory: on a full disk there is no file to put them in.
    local errors
    { errors=$(TMPDIR="$work/tmp" PYTHONDONTWRITEBYTECODE=1 PIP_REQUIRE_VIRTUALENV=0 \
        timeout "$LONGEST_WAIT_SECS" python3 -m pip download --disable-pip-version-check --no-cache-dir --no-deps --require-hashes \
        --only-binary=:all: --implementation cp --python-version 311 --abi cp311 --abi none \
        --platform manylinux_2_28_x86_64 --platform manylinux_2_25_x86_64 \
        --platform manylinux_2_17_x86_64 --platform manylinux2014_x86_64 \
        --requirement "$work/requirements.txt" --dest "$work/wheels" 2>&1 >&3) ||
        explain_failed_download "$?" "$errors"; } 3>&2
    rm -rf "$work/tmp"
}

explain_failed_download() {
    local status=$1 errors=$2
    ((status != 124)) ||
        fail "the download was not done after $((LONGEST_WAIT_SECS / 60)) minutes: run again on a faster connection, or set LIBTORCH to your own libtorch $TORCH_VERSION"
    case $errors in
        *"DO NOT MATCH THE HASHES"*)
            fail "a downloaded wheel does not have the pinned hash; it was thrown away: run again, and if it happens again look at what your proxy or package mirror serves" ;;
        *"No space left"* | *"Disk quota exceeded"*)
            fail "the disk filled up during the download: free $NEEDED_MB MB on the file system of $repository and run again" ;;
        *Retrying* | *onnection* | *Timeout*)
            fail "pip could not reach its package index: check the network and pip's proxy or mirror settings, then run again" ;;
        *)
            fail "pip could not download libtorch (${errors##*$'\n'}): put this right, then run again" ;;
    esac
}

# libtorch.so itself is an empty shell that names libtorch_cuda.so: a link to the CPU library takes its place. The link named
# libgomp.so lets "-lgomp" find the one OpenMP runtime that libtorch_cpu.so uses too.
unpack() {
    local errors
    errors=$(PYTHONDONTWRITEBYTECODE=1 python3 - "$work/wheels" "$work/libtorch" 2>&1 <<'END'
import os, pathlib, shutil, sys, zipfile

wheels, target = map(pathlib.Path, sys.argv[1:])
LIBRARIES = {
    "torch/lib/libtorch_cpu.so",
    "torch/lib/libc10.so",
    "torch/lib/libgomp.so.1",
    "nvidia/cu13/lib/libcudart.so.13",
    "nvidia/cu13/lib/libcupti.so.13",
}
missing = set(LIBRARIES)
for wheel in sorted(wheels.glob("*.whl")):
    with zipfile.ZipFile(wheel) as archive:
        for entry in archive.infolist():
            name = entry.filename
            if entry.is_dir():
                continue
            if name in LIBRARIES:
                missing.remove(name)
                path = target / "lib" / pathlib.PurePosixPath(name).name
            elif name.startswith("torch/include/"):
                path = target / pathlib.PurePosixPath(name).relative_to("torch")
            else:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(entry) as source, open(path, "wb") as copy:
                shutil.copyfileobj(source, copy, 1 << 20)
if missing:
    sys.exit("not in the wheels: " + ", ".join(sorted(missing)))
os.symlink("libtorch_cpu.so", target / "lib" / "libtorch.so")
os.symlink("libgomp.so.1", target / "lib" / "libgomp.so")
END
    ) || fail "could not unpack libtorch (${errors##*$'\n'}): free $NEEDED_MB MB on the file system of $repository if it is full, and run again"
    printf '%s\n' "$BUILD_VERSION" >"$work/libtorch/build-version"
}

move_into_place() {
    if [[ -e $target || -L $target ]]; then
        mv "$target" "$work/replaced"
    fi
    mv -T "$work/libtorch" "$target"
}

main() {
    case ${1-} in
        '') ;;
        -h | --help) usage; exit 0 ;;
        *)
            echo "setup.sh: unknown argument \"$1\": see launch/setup.sh --help" >&2
            exit 2
            ;;
    esac
    check_tools
    if [[ -n ${LIBTORCH-} ]]; then
        use_own_libtorch
        return
    fi
    if is_complete; then
        return
    fi
    check_download_is_possible

    # One at a time; the lock goes with the process. What an earlier, killed run left aside is then nobody's and is removed.
    exec 9<"$repository"
    flock --nonblock 9 || {
        say "another set-up is under way, waiting for it"
        flock --timeout "$LONGEST_WAIT_SECS" 9 ||
            fail "another set-up has been under way for $((LONGEST_WAIT_SECS / 60)) minutes: see what it does (fuser $repository), end it, and run again"
    }
    if is_complete; then
        return
    fi
    rm -rf "$target".partial.*
    work=$(mktemp -d "$target.partial.XXXXXX")
    trap remove_work EXIT
    trap 'exit 130' INT
    trap 'exit 143' TERM HUP
    say "fetching libtorch $TORCH_VERSION (540 MB) into $target"
    download
    say "unpacking"
    unpack
    move_into_place
    say "libtorch is ready"
}

main "$@"
