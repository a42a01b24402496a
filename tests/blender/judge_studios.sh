#!/bin/sh
# tests/blender/judge_studios.sh OUT [SUBJECT:SEED...] - studios that Blender's Cycles traced (make_studio.py; default bust:3 torus:2 monkey:1), solved
# (SOLVE_OPTIONS: --texture 256 --seed 1), and rendered under lights that the solve has not seen. Prints what was found, held-out and relit RMSE; the truth
# lies in OUT/<subject>-<seed>/truth. A studio that is there is not made again (each takes minutes). BIN is where rigsolve lies.
# Needs blender and python3-numpy (apt-get install --no-install-recommends); not part of `make test`.
set -eu
out=${1:?usage: judge_studios.sh OUT [SUBJECT:SEED...]} rigsolve=${BIN:-build/bin}/rigsolve
shift
command -v blender >/dev/null || { echo "judge_studios: no blender here: apt-get install --no-install-recommends blender python3-numpy" >&2; exit 1; }
[ $# -gt 0 ] || set -- bust:3 torus:2 monkey:1
mkdir -p "$out"
for which; do
    subject=${which%:*} seed=${which#*:}
    take=$out/$subject-$seed
    if ! [ -d "$take" ]; then
        echo "$subject $seed: Cycles renders 42 views and two panoramas" >&2
        rm -rf "$take.part"
        blender -b --factory-startup --python-exit-code 1 --python tests/blender/make_studio.py -- "$take.part" "$subject" "$seed" >"$take.log" 2>&1 ||
            { tail -n 20 "$take.log" >&2; exit 1; }
        mv "$take.part" "$take"
    fi
    code=0
    # shellcheck disable=SC2086 # options are words
    "$rigsolve" solve "$take" -o "$take.solve" --stage 2 --hold-out "list:$take/unseen.txt" ${SOLVE_OPTIONS:---texture 256 --seed 1} >"$take.txt" || code=$?
    [ $code = 0 ] || [ $code = 3 ] || exit $code
    rm -rf "$take.relit"
    "$rigsolve" render "$take.solve" --cameras "$take/relit/cameras" --panorama "$take/relit/panorama.exr" --world-from-probe "$take/relit/probe.json" \
        --panels "$take/relit/lights.json" -n 4096 --size 360x240 -o "$take.relit" >/dev/null
    rm -f "$take.relit"/*.png
    echo "$subject $seed: $([ $code = 0 ] && echo trusted || echo not trusted)"
    grep -E '^(centre|materials|region)' "$take.txt"
    printf 'relit: '
    "$rigsolve" compare "$take.relit" "$take/relit/linear" --mask "$take/relit/mask" | tail -n 1
done
