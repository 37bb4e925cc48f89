# The sensor server on any CPU:
#   docker build -t nurec-sim .
#   docker run --rm -p 127.0.0.1:8080:8080 -v "$PWD/scenes:/scenes:ro" nurec-sim
# docs/serving_operations.md has how to pin BASE by its digest, and a smaller TORCH by its hash.
ARG BASE=python:3.12-slim-bookworm
FROM ${BASE}

RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libglib2.0-0 libgomp1 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 10001 nurec \
    && install --directory --owner nurec /cache /scenes

ARG TORCH=torch
WORKDIR /opt/nurec-sim
COPY pyproject.toml setup.py constraints.txt README.md LICENSE ./
COPY nurec_sim nurec_sim
COPY policies policies
COPY protos protos
COPY scenarios scenarios
RUN pip install --no-cache-dir --constraint constraints.txt "${TORCH}" .

# Kernels that numba compiles and reconstructed clips are kept in /cache: with a volume the next start is quicker.
ENV NUREC_SIM_CACHE=/cache NUMBA_CACHE_DIR=/cache/numba PYTHONUNBUFFERED=1
USER nurec
WORKDIR /scenes
VOLUME /cache
EXPOSE 8080 8081
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=120s CMD ["nurec-sim", "health", "127.0.0.1:8081"]
ENTRYPOINT ["nurec-sim"]
CMD ["serve-grpc", "--host=0.0.0.0", "--port=8080", "--health-port=8081", "--artifact-glob=/scenes/**/*.usdz"]
