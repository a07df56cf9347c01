#!/usr/bin/env bash
# Writes a snapshot as an ONNX graph.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein export -- "$@" <<END
launch/export.sh --snapshot FILE --onnx FILE builds skein, without the learner, and runs "skein export" with these options.
END

cargo_build "building skein (about 3 minutes on two cores the first time)" --bin skein
run_built skein export "$@"
