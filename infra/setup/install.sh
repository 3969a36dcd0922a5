#!/bin/sh
# install.sh PYTHON LOCK...: installs locks of requirements/, such as `dataset`, and nothing else.
# Every file has a digest that its lock names, and is a wheel, but for the packages named here: they
# have none, and are built by what the lock `build` has installed, without fetching anything more.
set -eu
case $1 in /*) python=$1 ;; *) python=$PWD/$1 ;; esac
shift
cd "$(dirname "$0")/../../requirements"

without_wheel=meshoptimizer,gputil,jsonpath-rw

# A lock names all that is needed, so pip need not look further: some releases refuse
# `package[extra]` of another package beside the digest of `package`. `pip check` says what is missing.
install() {
    "$python" -m pip install --quiet --require-hashes --no-build-isolation --no-deps \
        --only-binary :all: --no-binary "$without_wheel" "$@"
}

# torch's build for graphics cards needs CUDA's libraries; which build it is, its metadata say
install_torch_alone() {
    alone=$(mktemp)
    awk '/^torch==/ { on = 1 } on { print } on && !/\\$/ { exit }' all.txt >"$alone"
    # pip takes a file of an index before one of a folder (`--find-links`), which alone states no
    # digest: a build that somebody has put into a folder is meant, so that is looked at first
    install --no-index --requirement "$alone" 2>/dev/null || install --requirement "$alone"
    rm "$alone"
}
needs_cuda() {
    "$python" -c 'import sys; from importlib.metadata import requires
needed = [row for row in requires("torch") or () if row.startswith(("nvidia-", "cuda-"))]
sys.exit(not (needed and sys.platform == "linux"))'
}

install --requirement build.txt
for lock in "$@"; do
    more=""
    if [ "$lock" = all ]; then
        install_torch_alone
        ! needs_cuda || more="--requirement cuda.txt"
    fi
    # shellcheck disable=SC2086
    install --requirement "$lock.txt" $more
done
"$python" -m pip check >/dev/null || {
    "$python" -m pip check
    exit 1
}
