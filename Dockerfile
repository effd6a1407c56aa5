# A small image for render farms and CI: `docker build -t splat4d .`, `docker run --rm -v "$PWD:/work" splat4d train my-take`.
# On a computer of your own the program itself is less trouble.
FROM rust:1-alpine AS build
RUN apk add --no-cache musl-dev
COPY . /src
WORKDIR /src
RUN cargo build --profile dist --locked

FROM alpine:3
RUN apk add --no-cache ffmpeg
COPY --from=build /src/target/dist/splat4d /src/target/dist/s4d /usr/local/bin/
WORKDIR /work
ENTRYPOINT ["splat4d"]
