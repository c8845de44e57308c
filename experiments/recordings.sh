#!/bin/sh
# Scores the detector on the recordings in the folder CONICFLOW_DATA, and the tracker on the sequence among them; arguments are
# passed on to `conicflow run`:
#   CONICFLOW_DATA=~/frames experiments/recordings.sh --set extractor.scan='"both"'
set -eu
: "${CONICFLOW_DATA:?names the folder with the recordings, one folder with a truth.json for each}"
here=$(dirname "$0")
conicflow=${CONICFLOW:-conicflow}

score() { # EXPERIMENT FOLDER FRAMES [ARGUMENT]...
    experiment=$1 folder=$CONICFLOW_DATA/$2 frames=$CONICFLOW_DATA/$3
    shift 3
    printf '\n== %s: %s\n' "$experiment" "$folder"
    "$conicflow" run --quiet "$here/$experiment.toml" \
        --set "source.path=\"$frames\"" --set "evaluation.truth=\"$folder/truth.json\"" "$@"
}

score recording osd-tabletop osd-tabletop "$@"
score recording pcl-table-mug pcl-table-mug "$@"
score recording ycb-xtion ycb-xtion --set source.depth_scale=0.0001 \
    --set 'source.intrinsics={ fx = 1066.778, fy = 1067.487, cx = 312.9869, cy = 241.3109 }' "$@"
score recording ball-kinect-cam1 ball-kinect-cam1/depth "$@"
score recorded_tracks ball-kinect-cam1 ball-kinect-cam1/depth "$@"
