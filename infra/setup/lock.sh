#!/bin/sh
# Writes requirements/*.txt from requirements/*.in: exact versions and the sha256 of every file of
# them; no index, no local build tags. The indices are those that pip is set up with: to know the
# digest of a build of torch, run it where pip finds that build, beside the public one.
set -eu
cd "$(dirname "$0")/../../requirements"

lock() {
    output=$1
    shift
    pip-compile --quiet --strip-extras --allow-unsafe --no-header --no-annotate --no-emit-options \
        --no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
        --output-file "$output" "$@"
    # torch's CPU build calls itself 2.13.0+cpu; the lock admits every build of the version
    sed -i 's/^\(torch==[0-9.]*\)+.*/\1/' "$output"
}

lock dataset.txt dataset.in
lock served.txt --constraint dataset.txt dataset.in served.in
lock all.txt all.in
lock docs.txt docs.in
lock build.txt build.in

# What CUDA's build needs, and all.txt has not: a pip without a private index resolves that build.
cuda=$(mktemp)
PIP_CONFIG_FILE=/dev/null PIP_FIND_LINKS='' PIP_EXTRA_INDEX_URL='' pip-compile --quiet --no-header \
    --strip-extras --no-annotate --no-emit-options --output-file "$cuda" cuda.in
grep -E '^(nvidia|cuda|triton)-?' "$cuda" >cuda.txt
rm "$cuda"

cd ..
python -m infra.setup.hashes requirements/*.txt infra/bench/workloads/blender.txt
