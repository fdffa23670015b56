# syntax=docker/dockerfile:1
# Two stages: the first builds a virtual environment with Pliant and its web page, the second copies it. The final image holds
# neither wheels nor build tools, in no layer.
ARG PYTHON=python:3.12.12-slim-bookworm

FROM ${PYTHON} AS build
# For example server,usd,otel: see docs/how-to/install.md.
ARG EXTRAS=server
WORKDIR /source
COPY . .
ENV PLIANT_PAGE=required PIP_DISABLE_PIP_VERSION_CHECK=1
RUN --mount=type=cache,target=/root/.cache/pip \
    python -m venv /opt/pliant \
    && /opt/pliant/bin/python -m pip install --constraint constraints.txt ".[${EXTRAS}]"

FROM ${PYTHON}
ARG VERSION=0.1.0
LABEL org.opencontainers.image.title="Pliant" \
      org.opencontainers.image.description="Dense 2-D point tracks of a deforming object in, a moving 3-D mesh out." \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.licenses="MIT"
RUN useradd --create-home --uid 10001 pliant && install --directory --owner=pliant --mode=0700 /data
COPY --from=build /opt/pliant /opt/pliant
ENV PATH=/opt/pliant/bin:$PATH PLIANT_DATA=/data PYTHONUNBUFFERED=1
USER 10001
WORKDIR /data
VOLUME /data
EXPOSE 8000
# Liveness of the API alone: a container without workers is not broken. Containers that run something else override it.
HEALTHCHECK --interval=15s --timeout=5s --start-period=60s --retries=4 \
    CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8000/healthz', timeout=4)"]
# Alone, the image is the whole service: API, workers and embedded Valkey in one container. It requires tokens, so create one first:
#   docker run --rm -v pliant:/data pliant pliant token create me
#   docker run --stop-timeout 40 -v pliant:/data -p 127.0.0.1:8000:8000 pliant
# Docker's own 10 s to stop would cut off running jobs, which have PLIANT_STOP_GRACE seconds before they return to the queue.
CMD ["pliant", "up", "--host", "0.0.0.0", "--port", "8000"]
