#!/usr/bin/env bash
# Makes a package for Debian and Ubuntu from the sources here, and prints where it is: packaging/deb.sh [PROFILE]
#
# It needs `cargo install cargo-deb` and `cargo install cargo-about --features cli`, a Rust toolchain and a C compiler. PROFILE is that of cargo, `release` unless told otherwise.
set -euo pipefail
cd "$(dirname "$0")/.."
profile="${1:-release}"
target="${CARGO_TARGET_DIR:-target}"
built="$target/$([ "$profile" = dev ] && echo debug || echo "$profile")"

cargo build --profile "$profile" --locked -p conicflow -p conicflow-bridge -p conicflow-c

# What the program tells of itself, the names by which the library is found, the licences of what all is made of, and the examples with the place of the schema that is installed with it.
made=target/deb
rm -rf "$made" && mkdir -p "$made"
for shell in bash zsh fish; do
    "$built/conicflow" completions "$shell" >"$made/conicflow.$shell"
done
"$built/conicflow" man | gzip -9n >"$made/conicflow.1.gz"
"$built/conicflow" schema >"$made/pipeline.schema.json"
for example in pipeline.toml pipeline.two-machines.toml examples/camera.toml examples/ros2.toml; do
    sed '1s|.*|#:schema /usr/share/conicflow/pipeline.schema.json|' "$example" >"$made/$(basename "$example")"
done
name="$(readelf -d "$built/libconicflow.so" | sed -n 's/.*soname: \[\(.*\)\]/\1/p')"
strip --strip-unneeded -o "$made/$name" "$built/libconicflow.so"
ln -s "$name" "$made/libconicflow.so"
# It looks also at packages that this machine does not build, and asks nobody on the network about licences.
cargo fetch --locked
cargo about generate --workspace --locked --offline --fail -c packaging/licences.toml packaging/licences.hbs |
    gzip -9n >"$made/third-party-licences.txt.gz"

cargo deb --no-build --locked --profile "$profile"
