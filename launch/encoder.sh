#!/usr/bin/env bash
# Trains an encoder on images from random poses, before any run, or measures one.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein-encoder -- "$@" <<END
launch/encoder.sh OPTIONS builds what is needed and runs "skein encoder" with these options. By
default it trains by configs/encoder.toml.
END

build_encoder
run_built skein encoder --config "$repository/configs/encoder.toml" "$@"
