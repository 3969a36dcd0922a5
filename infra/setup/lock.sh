#!/bin/sh
# Writes requirements/*.txt from requirements/*.in: exact versions, no index, no local build tags.
set -eu
cd "$(dirname "$0")/../../requirements"

lock() {
    output=$1
    shift
    pip-compile --quiet --strip-extras --no-header --no-annotate --no-emit-options \
        --no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
        --output-file "$output" "$@"
    # torch's CPU build calls itself 2.13.0+cpu; the lock admits every build of the version
    sed -i 's/^\(torch==[0-9.]*\)+.*/\1/' "$output"
}

lock dataset.txt dataset.in
lock served.txt --constraint dataset.txt dataset.in served.in
lock all.txt all.in
lock docs.txt docs.in
