# Two stages: the first builds the wheel (and in it the web page), the second holds only what runs.
FROM python:3.12-slim AS build
WORKDIR /source
COPY . .
ENV PLIANT_PAGE=required
RUN python -m pip wheel --no-cache-dir --constraint constraints.txt --wheel-dir /wheels '.[server]'

FROM python:3.12-slim
RUN useradd --create-home --uid 10001 pliant && install --directory --owner=pliant /data
COPY --from=build /wheels /wheels
RUN python -m pip install --no-cache-dir --no-index --find-links=/wheels 'pliant[server]' && rm -rf /wheels
USER 10001
WORKDIR /data
ENV PLIANT_DATA=/data PYTHONUNBUFFERED=1
VOLUME /data
EXPOSE 8000
# Alone, the image is the whole service: API, workers and embedded Valkey in one container. It asks for tokens, so make one first:
#   docker run --rm -v pliant:/data pliant pliant token create me
#   docker run -v pliant:/data -p 127.0.0.1:8000:8000 pliant
CMD ["pliant", "up", "--host", "0.0.0.0", "--port", "8000"]
