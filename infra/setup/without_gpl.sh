#!/bin/sh
# Takes what is under the GPL, or not free, out of an environment; meshes are then made by libigl,
# without the profile `uniform`; videos are .webp.
set -eu
python=$1

"$python" -m pip uninstall --quiet --yes pymeshlab av
# The wheel of libigl (MPL-2.0) carries bindings of CGAL and TetGen (GPL, AGPL) and of Triangle
# (no commercial use); its core does not need them.
folder=$("$python" -c 'import importlib.util as u; print(u.find_spec("igl").submodule_search_locations[0])')
rm -rf "$folder/copyleft" "$folder/triangle"
