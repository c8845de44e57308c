#!/usr/bin/env bash
# Makes a package for Debian and Ubuntu from the sources here, and prints where it is: packaging/deb.sh [PROFILE]
#
# It needs `cargo install cargo-deb`, a Rust toolchain and a C compiler. PROFILE is that of cargo, `release` unless told otherwise.
set -euo pipefail
cd "$(dirname "$0")/.."
profile="${1:-release}"
target="${CARGO_TARGET_DIR:-target}"
built="$target/$([ "$profile" = dev ] && echo debug || echo "$profile")"

cargo build --profile "$profile" --locked -p conicflow -p conicflow-bridge

# What the program tells of itself, and the example with the place of the schema that is installed with it.
made=target/deb
rm -rf "$made" && mkdir -p "$made"
for shell in bash zsh fish; do
    "$built/conicflow" completions "$shell" >"$made/conicflow.$shell"
done
"$built/conicflow" man | gzip -9n >"$made/conicflow.1.gz"
"$built/conicflow" schema >"$made/pipeline.schema.json"
sed '1s|.*|#:schema /usr/share/conicflow/pipeline.schema.json|' pipeline.toml >"$made/pipeline.toml"

cargo deb --no-build --locked --profile "$profile"
