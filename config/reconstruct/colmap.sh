#!/bin/sh
# colmap.sh TAKE - a reconstruction hook for rigd ([reconstruct] command = .../colmap.sh): the cameras, by COLMAP on the CPU.
#
# Leaves TAKE/geometry/cameras/{cameras,images,points3D}.bin, with the names of TAKE/linear/*.exr, and TAKE/geometry/mesh.*. Set in rigd's environment:
#   MESH        the mesh, with a UV atlas and in the frame of POSITIONS. COLMAP makes dense surfaces with CUDA only (Debian's makes none), so it comes
#               from elsewhere: a scan, an earlier take of a fixed object, OpenMVS
#   POSITIONS   a file of lines "A01.png X Y Z": where bodies stand, in metres. Gives the cameras scale and axes (model_aligner). Without it both are
#               arbitrary, and neither MESH nor a start.json can fit
# Tried with Debian 12's COLMAP 3.8 on two path-traced studios (480 x 320 px, one polished object in a dark room): every step runs, and it refuses -
# features are too few, two of 40 views were placed, or none. It has not been seen to succeed on photographs of a studio here: expect to tune it, and
# prefer [reconstruct] calibrated = DIR wherever the cameras stand still.
set -eu
take=${1:?usage: colmap.sh TAKE} tools=${RIGD_TOOLS:-/usr/local/bin} threads=$(nproc)
work=$take/geometry/.colmap # hidden: nobody takes it for a result
rm -rf "$work"
mkdir -p "$work/sparse" "$take/geometry/cameras"
trap 'rm -rf "$work"' EXIT
export QT_QPA_PLATFORM=offscreen
say() { [ -z "${STUDIORIG_PROGRESS_FD:-}" ] || echo "{\"stage\":\"$1\",\"done\":$2,\"total\":5}" >&"$STUDIORIG_PROGRESS_FD"; }

say pictures 0
"$tools/rigd-contact" --linear "$take" -o "$work/sheet.png" --pictures "$work/pictures"
say features 1
colmap feature_extractor --database_path "$work/db" --image_path "$work/pictures" --ImageReader.camera_model OPENCV --SiftExtraction.use_gpu 0 --SiftExtraction.num_threads "$threads"
say matches 2
colmap exhaustive_matcher --database_path "$work/db" --SiftMatching.use_gpu 0 --SiftMatching.num_threads "$threads"
say cameras 3
colmap mapper --database_path "$work/db" --image_path "$work/pictures" --output_path "$work/sparse" --Mapper.num_threads "$threads" --Mapper.multiple_models 0
[ -f "$work/sparse/0/cameras.bin" ] || { echo "error: colmap.sh: COLMAP placed no cameras: more overlap or texture is needed" >&2; exit 1; }
if [ -n "${POSITIONS:-}" ]; then
    mkdir "$work/aligned"
    colmap model_aligner --input_path "$work/sparse/0" --output_path "$work/aligned" --ref_images_path "$POSITIONS" --ref_is_gps 0 --alignment_type custom \
        --robust_alignment 1 --robust_alignment_max_error 0.05
else
    mv "$work/sparse/0" "$work/aligned"
fi
say mesh 4
[ -n "${MESH:-}" ] || { echo "error: colmap.sh: no mesh: name one in MESH (this script's head says why)" >&2; exit 1; }
cp "$MESH" "$take/geometry/mesh.${MESH##*.}"
cp "$work"/aligned/*.bin "$take/geometry/cameras/"
say done 5
