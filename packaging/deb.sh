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

# The Python package, as its wheel has it: one for all versions of Python, so that none is needed here.
PYO3_NO_PYTHON=1 PYO3_BUILD_EXTENSION_MODULE=1 CARGO_TARGET_DIR="$target/python-deb" \
    cargo build --profile "$profile" --locked --lib --manifest-path python/Cargo.toml
mkdir -p "$made/python/conicflow/cameras"
cp python/conicflow/*.py python/conicflow/*.pyi python/conicflow/py.typed "$made/python/conicflow/"
cp python/conicflow/cameras/*.py "$made/python/conicflow/cameras/"
strip --strip-unneeded -o "$made/python/conicflow/_conicflow.abi3.so" "$target/python-deb/$(basename "$built")/lib_conicflow.so"

# It looks also at packages that this machine does not build, and asks nobody on the network about licences.
for workspace in . python; do
    cargo fetch --locked --manifest-path "$workspace/Cargo.toml"
    cargo about generate --manifest-path "$workspace/Cargo.toml" --workspace --locked --offline --fail \
        -c packaging/licences.toml packaging/licences.hbs | gzip -9n
done >"$made/third-party-licences.txt.gz"

cargo deb --no-build --locked --profile "$profile"
