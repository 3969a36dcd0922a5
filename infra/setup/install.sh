#!/bin/sh
# install.sh PYTHON LOCK...: installs locks of requirements/, such as `dataset`, and nothing else.
# Every file has a digest that its lock names, and is a wheel, but for two packages of pure Python:
# they have none, and are built by what the lock `build` has installed, without fetching anything more.
# uv installs, where the machine has it or pip brings it; else pip does.
set -eu
case $1 in /*) python=$1 ;; *) python=$PWD/$1 ;; esac
shift
cd "$(dirname "$0")/../../requirements"

with_pip() {
    "$python" -m pip install --quiet --require-hashes --no-build-isolation --no-deps \
        --only-binary :all: --no-binary gputil,jsonpath-rw "$@"
}

# uv has settings of its own for what pip's say
[ -z "${PIP_CERT:-}" ] || export SSL_CERT_FILE="${SSL_CERT_FILE:-$PIP_CERT}"
[ -z "${PIP_FIND_LINKS:-}" ] || export UV_FIND_LINKS="${UV_FIND_LINKS:-$PIP_FIND_LINKS}"
[ -z "${PIP_INDEX_URL:-}" ] || export UV_DEFAULT_INDEX="${UV_DEFAULT_INDEX:-$PIP_INDEX_URL}"
uv=$(command -v uv || true)
if [ -z "$uv" ] && with_pip --requirement uv.txt 2>/dev/null; then
    uv=$(dirname "$python")/uv
fi

# A lock names all that is needed, so nothing need be looked up: some releases refuse
# `package[extra]` of another package beside the digest of `package`. `pip check` says what is missing.
install() {
    if [ -n "$uv" ]; then
        "$uv" pip install --quiet --python "$python" --require-hashes --no-build-isolation --no-deps \
            --only-binary :all: --no-binary gputil --no-binary jsonpath-rw "$@" && return
        echo "uv could not install this; pip tries, which knows this machine's own settings." >&2
        uv=
    fi
    with_pip "$@"
}

# torch's build for graphics cards needs CUDA's libraries; which build it is, its metadata say
install_torch_alone() {
    alone=$(mktemp)
    awk '/^torch==/ { on = 1 } on { print } on && !/\\$/ { exit }' all.txt >"$alone"
    # an index comes before a folder (`--find-links`), which alone states no digest: a build that
    # somebody has put into a folder is meant, so that is looked at first
    with_pip --no-index --requirement "$alone" 2>/dev/null || install --requirement "$alone"
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
