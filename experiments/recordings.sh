#!/bin/sh
# Scores the tracker on the sequence among the recordings in the folder CONICFLOW_DATA, then the detector on all of them, one
# folder for each. Lists what was found, missed and wrong in each frame, then one table with a row for each recording. In recordings
# without a truth.json nothing is to be found.
#
#   --pictures DIR   draws every frame with its answers into DIR/RECORDING
#   --flip WAYS      shows the detector frames that are turned or mirrored: none, clockwise, counterclockwise, upside_down,
#                    horizontal, vertical; several in quotes, of which a further table has the sums
#
# Other arguments are passed on to `conicflow run`:
#   CONICFLOW_DATA=~/frames experiments/recordings.sh --flip 'none clockwise' --set extractor.scan='"both"'
set -eu
: "${CONICFLOW_DATA:?names the folder with the recordings}"
here=$(cd "$(dirname "$0")" && pwd)
data=$(cd "$CONICFLOW_DATA" && pwd)
conicflow=${CONICFLOW:-conicflow}
pictures=
flips=
while :; do
    case ${1-} in
    --pictures)
        mkdir -p "${2:?--pictures wants a folder}"
        pictures=$(cd "$2" && pwd)
        ;;
    --flip) flips=${2:?--flip wants a way, such as clockwise} ;;
    *) break ;;
    esac
    shift 2
done
case $pictures:$flips in
?*:*' '*)
    echo 'recordings.sh: pictures are drawn of one way at a time: --flip clockwise, for example' >&2
    exit 2
    ;;
esac
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# What image_source has to be told of a recording that does not tell itself.
camera_of() {
    case $1 in
    ycb-xtion) echo ', "source.depth_scale" = 0.0001, "source.intrinsics" = { fx = 1066.778, fy = 1067.487, cx = 312.9869, cy = 241.3109 }' ;;
    esac
}

# One case of the experiment for each folder that has frames.
recordings() {
    for folder in "$data"/*/; do
        folder=${folder%/}
        name=${folder##*/}
        frames=$folder truth=$folder/truth.json
        [ ! -d "$folder/depth" ] || frames=$folder/depth
        [ -e "$truth" ] || truth=$here/nothing_to_find.json
        ls "$frames" | grep -qiE '\.(png|pcd)$' || continue
        printf '    { name = "%s", set = { "source.path" = "%s", "evaluation.truth" = "%s"%s%s } },\n' "$name" "$frames" "$truth" \
            "$(camera_of "$name")" "${pictures:+, \"pictures.path\" = \"$pictures/$name\"}"
    done
}

# One case for each way to turn or mirror the frames, and the answers back.
ways() {
    for flip in $flips; do
        case $flip in
        clockwise) back=counterclockwise ;;
        counterclockwise) back=clockwise ;;
        *) back=$flip ;;
        esac
        printf '    { name = "%s", set = { "flipper.flip" = "%s", "back.flip" = "%s" } },\n' "$flip" "$flip" "$back"
    done
}

# Its list comes before those of the detector, so that the table stands at the end.
ball=$data/ball-kinect-cam1
[ -n "$flips" ] || [ ! -d "$ball" ] || {
    printf '== tracks in %s\n' "$ball"
    "$conicflow" run --quiet "$here/recorded_tracks.toml" --set "source.path=\"$ball/depth\"" \
        --set "evaluation.truth=\"$ball/truth.json\"" "$@"
}

{
    # the file has no path of its own, and one has to be there before the cases set theirs
    sed "/\"image_source\"/a\\
path    = \"$data\"
" "$here/${flips:+flipped_}recording.toml"
    if [ -n "$pictures" ]; then
        printf '\n[stage.pictures]\nnode   = "picture_sink"\ninput  = { topic = "objects", delivery = "lossless" }\n'
        printf 'inputs = { depth = { topic = "depth", delivery = "lossless" } }\nnames  = "source"\npath   = "%s"\n' \
            "$pictures"
    fi
    printf '\n[experiment]\ntitle   = "detection on recorded frames"\ncsv     = "%s/results/recordings.csv"\n' "$here"
    printf 'columns = ["frames", "to_find", "found", "wrong", "wrong_per_frame", "neither", "radius_error_mm", "radius_bias_mm", '
    printf '"position_error_mm", "axis_error_deg"]\nvary    = [\n'
    [ -z "$flips" ] || printf '{ name = "flip", cases = [\n%s\n] },\n' "$(ways)"
    printf '{ name = "recording", cases = [\n%s\n] }]\n' "$(recordings)"
    printf 'sums    = [\n'
    for group in ${flips:+flip} recording; do
        printf '    { by = "%s", columns = ["frames", "to_find", "found", "wrong"] },\n' "$group"
    done
    printf ']\n'
} >"$work/recordings.toml"
"$conicflow" run "$work/recordings.toml" "$@"
