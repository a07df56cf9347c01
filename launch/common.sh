# shellcheck shell=bash
# Sourced by the other scripts: where things lie, and how they are built.

repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
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

# Cargo reads .cargo/config.toml from the directory it is run in; the user's relative paths stay relative to where the user is.
build() {
    "$repository/launch/setup.sh"
    (cd "$repository" && cargo build --release --locked --workspace --bins) || {
        echo "the build failed; cargo's messages above say why" >&2
        exit 1
    }
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
