# docker build -f docker/cuda.Dockerfile -t logvggt-jax:cuda .
# CUDA comes with JAX's wheels; the host gives the driver: docker run --gpus all …
FROM python:3.12-slim

ARG EXTRAS=cuda,hub,viewer

WORKDIR /build
COPY pyproject.toml README.md LICENSE ./
COPY logvggt_jax ./logvggt_jax
RUN pip install --no-cache-dir ".[${EXTRAS}]" && rm -rf /build

RUN useradd --uid 1000 --create-home logvggt
USER logvggt
# A named volume that is mounted here gets this owner.
RUN mkdir ~/.cache
WORKDIR /data
ENTRYPOINT ["logvggt"]
CMD ["--help"]
