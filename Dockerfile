# Touchdown on the CPU. Needs the wheel in dist/: python -m pip wheel --no-deps --wheel-dir dist .
# Debian 12 brings Python 3.11, for which every dependency has a wheel.
FROM debian:bookworm-slim

RUN apt-get update -qq \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        ca-certificates python3 python3-venv libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri \
        libopengl0 libusb-1.0-0 libgomp1 libx11-6 \
    && rm -rf /var/lib/apt/lists/*

COPY constraints.txt dist/touchdown_sim-*.whl /tmp/
RUN python3 -m venv /opt/touchdown \
    && /opt/touchdown/bin/pip install --no-cache-dir --constraint /tmp/constraints.txt \
        /tmp/touchdown_sim-*.whl \
    && rm -f /tmp/constraints.txt /tmp/touchdown_sim-*.whl

# Compiled kernels and generated scenes are kept in the home of the user. A processor of another kind
# than that of the build compiles its own.
RUN useradd --create-home --uid 1000 pilot && install -d -o pilot -g pilot /runs
USER pilot
WORKDIR /runs
# The driver of a GPU that is given to the container has to bring OpenGL.
ENV PATH=/opt/touchdown/bin:$PATH MUJOCO_GL=egl NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility
RUN python -m touchdown.experiments.flight.kernels
ENTRYPOINT ["touchdown"]
CMD ["doctor"]
