#!/bin/sh
# Draws the pictures of docs/gallery.md anew: docs/gallery.sh [PATH/TO/conicflow]
set -eu
conicflow=$(realpath "${1:-target/release/conicflow}")
cd "$(dirname "$0")"

# A scene, so many frames of it, and every which of them is drawn.
draw() {
    "$conicflow" run gallery.toml --quiet --frames "$2" \
        --set "source.scene=$1" --set "pictures.moving=gallery/$1.png" --set "pictures.every=$3"
}

draw bouncing_ball     45  3
draw tabletop          25  4
draw tilted_cones       9  4
draw ball_on_cylinder   9  4
draw occluded_cylinder 250 30
