#!/usr/bin/env bash
# Copies the ONNX Runtime library out of its Python wheel into each folder given, where a nightfix executable that
# stands in the same folder finds it with neither option nor environment variable.
#
#   place-onnxruntime.sh PYTHON FOLDER...
set -euo pipefail

python=$1
shift
# find_spec locates the package without loading it.
capi=$("$python" -c 'import importlib.util as u, pathlib as p; print(p.Path(u.find_spec("onnxruntime").origin).parent / "capi")')
library=$(find "$capi" -maxdepth 1 -name 'libonnxruntime.so*' -print -quit)
if [[ -z $library ]]; then
    echo "nightfix: no libonnxruntime.so* in $capi" >&2
    exit 1
fi

for folder in "$@"; do
    mkdir -p "$folder"
    # One version only: the executable takes what it finds.
    find "$folder" -maxdepth 1 -name 'libonnxruntime.so*' ! -name "${library##*/}" -delete
    cmp -s "$library" "$folder/${library##*/}" || cp "$library" "$folder/"
done
