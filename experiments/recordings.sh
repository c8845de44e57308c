#!/bin/sh
# Scores the detector on the recordings in the folder CONICFLOW_DATA; arguments are passed on to `conicflow run`:
#   CONICFLOW_DATA=~/frames experiments/recordings.sh --set extractor.scan='"both"'
set -eu
: "${CONICFLOW_DATA:?names the folder with the recordings, one folder with a truth.json for each}"
here=$(dirname "$0")
conicflow=${CONICFLOW:-conicflow}

score() { # FOLDER FRAMES [ARGUMENT]...
    folder=$CONICFLOW_DATA/$1 frames=$CONICFLOW_DATA/$2
    shift 2
    printf '\n== %s\n' "$folder"
    "$conicflow" run --quiet "$here/recording.toml" \
        --set "source.path=\"$frames\"" --set "evaluation.truth=\"$folder/truth.json\"" "$@"
}

score osd-tabletop osd-tabletop "$@"
score pcl-table-mug pcl-table-mug "$@"
score ycb-xtion ycb-xtion --set source.depth_scale=0.0001 \
    --set 'source.intrinsics={ fx = 1066.778, fy = 1067.487, cx = 312.9869, cy = 241.3109 }' "$@"
score ball-kinect-cam1 ball-kinect-cam1/depth "$@"
