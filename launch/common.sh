# shellcheck shell=bash
# Sourced by the other scripts: where things lie, and how they are built.

# With it, cd may go elsewhere and prints where it went.
unset CDPATH
repository=$(cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.." && pwd -P)
readonly repository
# Where the default courses are, for whoever writes a configuration elsewhere.
export SKEIN_CONFIGS="$repository/configs"

# Ends the script with its help if one of the arguments asks for it; help must not need a build.
# What the script does comes from standard input, the options from the program that it hands over
# to, if that is built: help_if_asked [PROGRAM [SUBCOMMAND]] -- "$@"
help_if_asked() {
    local built_command=() argument built
    while [[ $1 != -- ]]; do
        built_command+=("$1") && shift
    done
    shift
    for argument in "$@"; do
        [[ $argument == -h || $argument == --help ]] || continue
        cat
        ((${#built_command[@]} > 0)) || exit 0
        built=$(target_directory || true)/release/${built_command[0]}
        echo
        [[ ! -x $built ]] || exec "$built" "${built_command[@]:1}" "$argument"
        echo "It is not built yet: once it is, this shows its options."
        exit 0
    done
}

# Builds what evaluation needs: no libtorch, no learner, no python.
build_evaluation() {
    local tool
    for tool in cargo:"Rust from https://rustup.rs, then open a new shell" cc:"a C compiler, on Debian or Ubuntu with: sudo apt install gcc"; do
        command -v "${tool%%:*}" >/dev/null || {
            echo "${tool%%:*} is missing: install ${tool#*:}" >&2
            exit 1
        }
    done
    cargo_build "building skein-evaluate and what flying needs (3 to 5 minutes on two cores the first time)" --bin skein-evaluate
}

# Builds what training needs.
build_training() {
    "$repository/launch/setup.sh"
    cargo_build "building learner, actor and supervisor, with libtorch (3 to 5 minutes on two cores the first time)" \
        --bin skein --bin skein-learner --bin skein-actor
}

# Builds what the training of an encoder needs.
build_encoder() {
    "$repository/launch/setup.sh"
    cargo_build "building what trains an encoder, with libtorch (3 to 5 minutes on two cores the first time)" \
        --bin skein --bin skein-encoder
}

# Builds what the page needs: no libtorch, no learner.
build_watch() {
    cargo_build "building the page of skein watch (about 2 minutes on two cores the first time)" --bin skein-watch
}

# Builds every program.
build() {
    "$repository/launch/setup.sh"
    cargo_build "building all programs (about 6 minutes on two cores the first time)" --bins
}

# Builds of the workspace what the arguments name; says what and how long only if something is to be done. Always --workspace: a
# package alone would be built with fewer features of shared packages, and all of them again for the next program.
cargo_build() {
    local what=$1 colour=never
    shift
    [[ ! -t 2 ]] || colour=always
    # Cargo reads .cargo/config.toml from the directory it is run in; the user's relative paths stay relative to where the user is.
    (cd "$repository" && CARGO_TERM_COLOR=$colour cargo build --release --locked --workspace "$@" 2>&1) | say_once "$what" >&2 || {
        echo "the build failed; cargo's messages above say why" >&2
        exit 1
    }
}

# Copies cargo's messages, after a line that says what is built. Copies nothing if nothing is built.
# A terminal or reader that is gone must not end the build.
say_once() {
    local what=$1 line
    trap '' PIPE
    while IFS= read -r line; do
        [[ $line != *Finished* ]] || continue
        [[ -z $what ]] || printf '%s\n' "$what" || true
        what=
        printf '%s\n' "$line" || true
    done 2>/dev/null
}

# Where cargo builds. Asked, not assumed: CARGO_TARGET_DIR or the user's own cargo configuration may put it elsewhere.
target_directory() {
    (cd "$repository" && cargo metadata --locked --no-deps --format-version 1) |
        sed -n 's/.*"target_directory":"\([^"]*\)".*/\1/p'
}

# Replaces the script by one of the built programs.
run_built() {
    local program=$1 target
    shift
    target=$(target_directory)
    exec "$target/release/$program" "$@"
}
