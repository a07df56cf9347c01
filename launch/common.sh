# shellcheck shell=bash
# Sourced by the other scripts: where things lie, and how they are built.

repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
readonly repository
# Where the default courses are, for whoever writes a configuration elsewhere.
export SKEIN_CONFIGS="$repository/configs"

# Prints the help text (standard input) and ends the script if one of the arguments asks for it: help must not need a build.
help_if_asked() {
    local argument
    for argument in "$@"; do
        if [[ $argument == -h || $argument == --help ]]; then
            cat
            exit 0
        fi
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
