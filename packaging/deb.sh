#!/usr/bin/env bash
# Makes a package for Debian and Ubuntu from the sources here, and prints where it is: packaging/deb.sh [PROFILE]
#
# It needs `cargo install cargo-deb` and `cargo install cargo-about@0.9.3 --features cli`, a Rust toolchain and a C compiler. PROFILE is that of cargo, `release` unless told otherwise.
set -euo pipefail
cd "$(dirname "$0")/.."
profile="${1:-release}"
target="${CARGO_TARGET_DIR:-target}"
built="$target/$([ "$profile" = dev ] && echo debug || echo "$profile")"

cargo build --profile "$profile" --locked -p conicflow -p conicflow-bridge -p conicflow-c

# What the program tells of itself, and the names by which the library is found.
made=target/deb
rm -rf "$made" && mkdir -p "$made"
for shell in bash zsh fish; do
    "$built/conicflow" completions "$shell" >"$made/conicflow.$shell"
done
"$built/conicflow" schema >"$made/pipeline.schema.json"
name="$(readelf -d "$built/libconicflow.so" | sed -n 's/.*soname: \[\(.*\)\]/\1/p')"
strip --strip-unneeded -o "$made/$name" "$built/libconicflow.so"
ln -s "$name" "$made/libconicflow.so"

# A file for each manual page, which has its name after two lines of its own.
mkdir "$made/man"
cp packaging/conicflow-bridge.1 "$made/man/"
"$built/conicflow" man | awk -v to="$made/man/" '
    /^\.ie / { start = $0; getline; start = start "\n" $0; next }
    /^\.TH / { page = to $2 ".1"; print start >page }
    { print >page }'
gzip -9n "$made"/man/*
ln -s conicflow.1.gz "$made/man/conicflow-help.1.gz"
ln -s conicflow-topic.1.gz "$made/man/conicflow-topic-help.1.gz"

# The manual with its pictures, and the examples, with the place of the schema that is installed with them. Links to what is not
# among them lead to the repository.
mkdir -p "$made/doc/docs" "$made/doc/examples/tls" "$made/doc/experiments"
cp README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE "$made/doc/"
cp -r docs/*.md docs/*.png docs/*.json docs/ros2_markers.py docs/pictures docs/gallery "$made/doc/docs/"
cp pipeline.toml pipeline.two-machines.toml examples/*.rs examples/*.py examples/*.toml c/example.c "$made/doc/examples/"
cp examples/tls/* "$made/doc/examples/tls/"
cp experiments/noise.toml "$made/doc/experiments/"
sed -i '1s|.*|#:schema /usr/share/conicflow/pipeline.schema.json|' "$made"/doc/ex*/*.toml
repository="$(sed -n 's/^repository = "\([^"]*\)".*/\1/p' Cargo.toml)/blob/HEAD"
(cd "$made/doc" && repository="$repository" perl -pi -e '
    my ($folder) = $ARGV =~ m|^(.*/)|;
    s{(\]\(|src=")(?!https?:|#)([^)#"\s]+)}{
        my ($start, $link, $path) = ($1, $2, ($folder // "") . $2);
        1 while $path =~ s|[^/]+/\.\./||;
        $start . (-e $path ? $link : "$ENV{repository}/$path")
    }ge' README.md CHANGELOG.md docs/*.md)

# The Python package, as its wheel has it: one for all versions of Python, so that none is needed here.
PYO3_NO_PYTHON=1 PYO3_BUILD_EXTENSION_MODULE=1 CARGO_TARGET_DIR="$target/python-deb" \
    cargo build --profile "$profile" --locked --lib --manifest-path python/Cargo.toml
mkdir -p "$made/python/conicflow/cameras"
cp python/conicflow/*.py python/conicflow/*.pyi python/conicflow/py.typed "$made/python/conicflow/"
cp python/conicflow/cameras/*.py "$made/python/conicflow/cameras/"
strip --strip-unneeded -o "$made/python/conicflow/_conicflow.abi3.so" "$target/python-deb/$(basename "$built")/lib_conicflow.so"

packaging/licences.sh . python | gzip -9n >"$made/doc/third-party-licences.txt.gz"
cp view/page/three/LICENSE "$made/doc/LICENSE-three.js"

cargo deb --no-build --locked --profile "$profile"
