# Trilight on processors: makes data, serves flows. Build from the checkout:
#   docker build --file infra/images/cpu.Dockerfile --tag trilight:latest .
# pymeshlab is GPL-3: an image that is passed on must be offered under terms that the GPL allows.
# WITHOUT_GPL=1 leaves it out.
FROM python:3.11.13-slim-bookworm@sha256:86adf8dbadc3d6e82ee5dd2c74bec2e1c2467cdad47886280501df722372d2e1 AS build
ARG WITHOUT_GPL=""
WORKDIR /opt/trilight
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
COPY requirements/ requirements/
COPY infra/setup/install.sh infra/setup/install.sh
COPY infra/setup/without_gpl.sh infra/setup/without_gpl.sh
RUN python -m venv /opt/venv \
    && PIP_NO_CACHE_DIR=1 infra/setup/install.sh /opt/venv/bin/python dataset served \
    && if [ -n "$WITHOUT_GPL" ]; then infra/setup/without_gpl.sh /opt/venv/bin/python; fi
COPY . .
RUN /opt/venv/bin/python -m pip install --no-cache-dir --no-deps --no-build-isolation --editable .

FROM python:3.11.13-slim-bookworm@sha256:86adf8dbadc3d6e82ee5dd2c74bec2e1c2467cdad47886280501df722372d2e1
ARG WITHOUT_GPL=""
LABEL org.opencontainers.image.title="trilight" \
      org.opencontainers.image.description="Makes the data for neural renderers" \
      org.opencontainers.image.licenses="MIT AND GPL-3.0-only" \
      trilight.without-gpl="$WITHOUT_GPL"
RUN useradd --uid 10001 --create-home trilight \
    && install --directory --owner trilight /data /cache
COPY --from=build --chown=root:root /opt/venv /opt/venv
COPY --from=build --chown=root:root /opt/trilight /opt/trilight
# what is called data/mine goes to the volume, whoever runs it
RUN ln --symbolic /data /opt/trilight/data
ENV PATH="/opt/venv/bin:$PATH" TRILIGHT_CACHE=/cache DO_NOT_TRACK=1 PYTHONUNBUFFERED=1
USER 10001
WORKDIR /opt/trilight
VOLUME ["/data", "/cache"]
CMD ["trilight", "doctor"]
