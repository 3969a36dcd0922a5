#!/bin/sh
# The whole story on one page: objects become meshes, scenes, pictures and shards; a network is
# trained on them, judged, and shown beside the path tracer. Run it from the checkout:
#
#   make setup-all
#   sh examples/whole_line.sh
#
# The defaults end in minutes on two cores and show that everything works. A network that has seen
# eight scenes for ten steps paints a mean grey, and its report says so. For a first real run:
#
#   OBJECTS=FOLDER SCENES=960 SCENES_PER_SHARD=16 STEPS=2400 sh examples/whole_line.sh
#
# Every step may be interrupted. Run the script again, and it goes on where it was.
set -eu

OBJECTS=${OBJECTS:-builtin:40}        # a folder of .glb .obj .ply ..., or procedural objects
SCENES=${SCENES:-8}                   # six or more have all three splits
SCENES_PER_SHARD=${SCENES_PER_SHARD:-1}
STEPS=${STEPS:-10}                    # of the network; a step sees four scenes
RESOLUTION=${RESOLUTION:-64}          # pictures are square
NOISE_FLOOR=${NOISE_FLOOR:-30}        # decibels at which sampling of a view stops
DATA=${DATA:-data/whole-line}
RUN=${RUN:-runs/whole-line}
export PATH="$(pwd)/.venv/bin:$PATH"

# 1. What this machine has, and what it lacks.
trilight doctor

# 2. Objects to meshes: each with the fewest triangles within half a percent of its source.
#    quality.html shows every mesh beside its source. Step 3 makes its own levels of detail.
trilight assets "$OBJECTS" --epsilon 0.5% --out "$DATA/meshes"

# 3. Meshes to scenes, scenes to path-traced pictures, pictures to shards. In every cycle of eight
#    shards the third is validation and the sixth is test, so that with one scene a shard eight
#    scenes have all three splits.
trilight generate tiny --objects "$DATA/meshes" --scenes "$SCENES" --resolution "$RESOLUTION" \
    --noise-floor "$NOISE_FLOOR" --set splits.scenes_per_shard="$SCENES_PER_SHARD" --out "$DATA/set"

# 4. Every hash, member and law; then what a person looks at: report.html, contact_sheet.png.
trilight verify "$DATA/set"
trilight inspect "$DATA/set"

# 5. Train. A run that was interrupted goes on from its newest checkpoint, to the bit.
if [ -d "$RUN/checkpoints" ]; then resume=--resume; else resume=; fi
trilight train tiny --data "$DATA/set" --steps "$STEPS" --out "$RUN" $resume

# 6. Judge: view by view beside each view's own stated error, and beside two baselines that have
#    learned nothing (the median picture, and the nearest training view).
trilight evaluate "$RUN" --data "$DATA/set" --split test --out "$RUN/evaluation"

# 7. One scene by the path tracer and by the network, side by side with their difference; and the
#    same scene as USD, for Blender and other programs.
scene=$(ls "$DATA"/set/train-*.tar | head -n 1)::000000000
trilight render "$scene" --engine both --checkpoint "$RUN" --resolution "$RESOLUTION" \
    --noise-floor "$NOISE_FLOOR" --out "$DATA/both.exr"
trilight convert "$scene" "$DATA/scene.usdz"

echo "Look at $DATA/meshes/quality.html, $DATA/set/report.html, $DATA/both.png, $RUN/evaluation"
