#!/bin/sh
# Writes requirements/*.txt from requirements/*.in: exact versions, no index, no local build tags.
set -eu
cd "$(dirname "$0")/../.."
for name in dataset served all docs; do
    pip-compile --quiet --strip-extras --no-header --no-annotate --no-emit-options \
        --no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
        --output-file "requirements/$name.txt" "requirements/$name.in"
    # torch's CPU build calls itself 2.13.0+cpu; the lock admits every build of the version
    sed -i 's/^\(torch==[0-9.]*\)+.*/\1/' "requirements/$name.txt"
done
