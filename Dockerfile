# One image for API and workers; docker-compose.yml says which command runs where.
ARG PYTHON_IMAGE=python:3.11-slim-bookworm
FROM $PYTHON_IMAGE AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/myoface
WORKDIR /opt/myoface/src
COPY locks/image.txt locks/
RUN /opt/myoface/bin/pip install --require-hashes -r locks/image.txt
COPY pyproject.toml README.md LICENSE ./
COPY docs/third-party-notices.md docs/
COPY service service
COPY worker worker
COPY solver solver
COPY myoface myoface
# Editable: the wheel has the client only, and the service runs from these folders.
RUN /opt/myoface/bin/pip install --no-deps --no-build-isolation --editable .
# Fetches the built-in face and makes its tetrahedra, which are then in the image.
RUN MYOFACE_CACHE=/opt/myoface/cache NUMBA_CACHE_DIR=/tmp/kernels \
    /opt/myoface/bin/python -m worker.kernels

FROM $PYTHON_IMAGE
RUN useradd --system --uid 10001 --create-home myoface \
    && install -d -o myoface -g myoface /data
COPY --from=build /opt/myoface /opt/myoface
ENV PATH=/opt/myoface/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/tmp/kernels \
    MYOFACE_DATA_DIR=/data \
    MYOFACE_CACHE=/opt/myoface/cache \
    MYOFACE_WORK_DIR=/tmp/work \
    MYOFACE_LOG_JSON=true
USER myoface
VOLUME /data
EXPOSE 8765
# Of the API; docker-compose.yml has the workers'.
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s CMD \
    ["python", "-c", "import httpx; httpx.get('http://127.0.0.1:8765/readyz').raise_for_status()"]
CMD ["python", "-m", "service"]
