# docker build -f docker/cpu.Dockerfile -t logvggt-jax:cpu .
FROM python:3.12-slim

ARG EXTRAS=hub,viewer

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
