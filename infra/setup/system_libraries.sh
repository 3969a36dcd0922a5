#!/bin/sh
# Installs the system libraries that wheels cannot bring, where apt may be used; says what is
# missing and goes on where it may not. `trilight doctor` tells what each of them is for.
set -u

have() { ldconfig -p 2>/dev/null | grep -q "$1"; }

# name of the library as the loader knows it : package that brings it
missing=""
have 'libOpenGL\.so\.0' || missing="$missing libopengl0"
have 'libGL\.so\.1' || missing="$missing libgl1"
have 'libatomic\.so\.1' || missing="$missing libatomic1"
# Mitsuba compiles with LLVM; releases before 16 abort in it, so they do not count.
ldconfig -p 2>/dev/null | grep -qE 'libLLVM(-|\.so\.)(1[6-9]|2[0-9])' || missing="$missing libllvm19"
# meshoptimizer comes as source: a compiler and Python's own headers.
command -v c++ >/dev/null 2>&1 || missing="$missing g++"
"$PYTHON" -c 'import os, sysconfig as s; os.stat(s.get_path("include") + "/Python.h")' 2>/dev/null ||
    missing="$missing python3-dev"
[ -n "$missing" ] || exit 0

run=""
[ "$(id -u)" -eq 0 ] || run="sudo -n"
if command -v apt-get >/dev/null 2>&1 && $run true 2>/dev/null; then
    echo "Installing system libraries:$missing"
    # shellcheck disable=SC2086
    $run apt-get update -qq && $run env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends $missing >/dev/null && exit 0
fi
echo "Not installed:$missing. Meshes need OpenGL's library and a compiler, rendering needs libatomic"
echo "and LLVM; trilight doctor tells more."
echo "Ask an administrator for: apt-get install$missing"
