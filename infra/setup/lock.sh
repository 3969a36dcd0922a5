#!/bin/sh
# Writes requirements/*.txt from requirements/*.in: exact versions for Python 3.11 and later, and the
# sha256 of every file of them; no index. Versions stay as they are where they may; `lock.sh --upgrade`
# takes the newest. Run it where PIP_FIND_LINKS names the folder with torch's build for processors: the
# lock then admits that build too.
set -eu
cd "$(dirname "$0")/../../requirements"

lock() {
    output=$1
    shift
    # shellcheck disable=SC2086
    uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
        --output-file "$output" $flags "$@"
}
flags=$*

lock dataset.txt dataset.in
lock served.txt --constraint dataset.txt dataset.in served.in
cat cuda.txt >>all.txt  # whose versions stay, too
lock all.txt --constraint served.txt all.in
lock docs.txt --constraint all.txt docs.in
lock build.txt --constraint all.txt build.in
lock uv.txt uv.in
lock readers.txt --no-deps readers.in
lock ../infra/bench/workloads/blender.txt ../infra/bench/workloads/blender.in

# What torch's build for graphics cards needs on Linux stands apart: the one for processors does not.
# A package begins at the margin, its digests are indented.
awk '/^[a-z]/ { cuda = /^(nvidia|cuda|triton)/ } cuda' all.txt >cuda.txt
awk '/^[a-z]/ { cuda = /^(nvidia|cuda|triton)/ } !cuda' all.txt >all.new && mv all.new all.txt
version=$(sed -n 's/^torch==\([0-9.]*\).*/\1/p' all.txt)
for wheel in "${PIP_FIND_LINKS:-/nowhere}"/torch-"$version"+cpu-*.whl; do
    [ -f "$wheel" ] || continue
    digest=$(sha256sum "$wheel" | cut -d ' ' -f 1)
    sed -i "s/^torch==$version .*/&\n    --hash=sha256:$digest \\\\/" all.txt
done
