# A small image for render farms and CI: `docker build -t splat4d .`, then
# `docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" splat4d train my-take`.
# On a computer of your own the program itself is less trouble. Without a GPU: musl programs open no Vulkan driver.
FROM rust:1.95.0-alpine3.23@sha256:606fd313a0f49743ee2a7bd49a0914bab7deedb12791f3a846a34a4711db7ed2 AS build
RUN apk add --no-cache musl-dev python3
COPY . /src
WORKDIR /src
RUN cargo build --profile dist --locked \
    && python3 .ci/extras.py notices target/extras/LICENSE-THIRD-PARTY

FROM alpine:3.24.2@sha256:294b683cb724975bec92580e1e685676bd4b50bda910ddb8c51d4cabeaec77e6
LABEL org.opencontainers.image.title="splat4d" \
      org.opencontainers.image.description="4D Gaussian splatting on any CPU: train, measure, compress and play dynamic 3D scenes" \
      org.opencontainers.image.source="https://github.com/splat4d/splat4d" \
      org.opencontainers.image.licenses="MIT OR Apache-2.0"
RUN apk add --no-cache ffmpeg && adduser -D -u 1000 splat4d
COPY --from=build /src/target/dist/splat4d /src/target/dist/s4d /usr/local/bin/
COPY --from=build /src/LICENSE-MIT /src/LICENSE-APACHE /src/target/extras/LICENSE-THIRD-PARTY /usr/share/licenses/splat4d/
USER 1000:1000
WORKDIR /work
ENTRYPOINT ["splat4d"]
