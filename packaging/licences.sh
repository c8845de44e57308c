#!/usr/bin/env bash
# Prints the licences of all packages that are in the programs of a workspace, or of several: packaging/licences.sh . python
#
# It needs `cargo install cargo-about@0.9.3 --features cli`.
set -euo pipefail
cd "$(dirname "$0")/.."
for workspace in "$@"; do
    # It looks also at packages that this machine does not build, and asks nobody on the network about licences.
    cargo fetch --locked --manifest-path "$workspace/Cargo.toml"
    cargo about generate --manifest-path "$workspace/Cargo.toml" --workspace --locked --offline --fail \
        -c packaging/licences.toml packaging/licences.hbs
done
