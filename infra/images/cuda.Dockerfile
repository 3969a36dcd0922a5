# Trilight for NVIDIA GPUs: renders and trains (docs/how-to/gpu.md).
#   docker build --file infra/images/cuda.Dockerfile --tag trilight:cuda .
# What the GPU here does, as one file to send back (docs/how-to/measure.md):
#   docker run --name gpu --gpus all --ipc=host trilight:cuda \
#       trilight bench gpu --out /data/gpu.jsonl
#   docker cp gpu:/data/gpu.jsonl .
# The driver comes from the host (nvidia-container-toolkit), and OptiX with it; torch brings CUDA's
# libraries itself.
FROM python:3.11.13-slim-bookworm@sha256:86adf8dbadc3d6e82ee5dd2c74bec2e1c2467cdad47886280501df722372d2e1 AS build
WORKDIR /opt/trilight
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
COPY requirements/ requirements/
COPY infra/setup/install.sh infra/setup/install.sh
RUN python -m venv /opt/venv \
    && PIP_NO_CACHE_DIR=1 infra/setup/install.sh /opt/venv/bin/python all served
COPY . .
RUN /opt/venv/bin/python -m pip install --no-cache-dir --no-deps --no-build-isolation --editable .

FROM python:3.11.13-slim-bookworm@sha256:86adf8dbadc3d6e82ee5dd2c74bec2e1c2467cdad47886280501df722372d2e1
LABEL org.opencontainers.image.title="trilight-cuda" \
      org.opencontainers.image.description="Makes the data for, trains and judges neural renderers" \
      org.opencontainers.image.licenses="MIT AND GPL-3.0-only"
RUN useradd --uid 10001 --create-home trilight \
    && install --directory --owner trilight /data /cache
COPY --from=build --chown=root:root /opt/venv /opt/venv
COPY --from=build --chown=root:root /opt/trilight /opt/trilight
# what is called data/mine goes to the volume, whoever runs it
RUN ln --symbolic /data /opt/trilight/data
ENV PATH="/opt/venv/bin:$PATH" TRILIGHT_CACHE=/cache DO_NOT_TRACK=1 PYTHONUNBUFFERED=1 \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
USER 10001
WORKDIR /opt/trilight
VOLUME ["/data", "/cache"]
CMD ["trilight", "doctor"]
