# Debian 13 packages dolfinx 0.9. The first stage alone is the environment that .ci/in-env uses.
FROM debian:trixie-slim AS env
COPY .ci/packages.txt .ci/pypi.txt .ci/check-blas /usr/local/share/magshell/
RUN apt-get update \
 && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
        $(sed 's/#.*//' /usr/local/share/magshell/packages.txt) \
 && rm -rf /var/lib/apt/lists/* \
 && /usr/local/share/magshell/check-blas
RUN python3 -m pip install --no-deps --no-cache-dir --break-system-packages -r /usr/local/share/magshell/pypi.txt
ENV OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 OMPI_MCA_btl=self,sm OMP_NUM_THREADS=1

FROM env
COPY . /usr/src/magshell
RUN python3 -m pip install --no-deps --no-index --no-build-isolation --no-cache-dir \
        --break-system-packages /usr/src/magshell
# Kernels are compiled here once. Whoever runs the image reads them; nobody but root may change them, and others go to
# a private folder (~/.cache/magshell, or in /tmp).
ENV XDG_CACHE_HOME=/var/cache/magshell MPLCONFIGDIR=/tmp/matplotlib HOME=/tmp
RUN magshell info --compile \
 && rm -rf "$MPLCONFIGDIR" \
 && chmod -R a+rX,go-w "$XDG_CACHE_HOME" \
 && useradd --uid 1000 --home-dir /tmp --no-create-home magshell \
 && mkdir -p -m 1777 /work
USER magshell
WORKDIR /work
ENTRYPOINT ["magshell"]
