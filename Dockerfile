# The batch in a container:
#   docker build -t super-sdf . && docker run -v "$PWD":/work super-sdf batch grids/ --out meshes/
FROM python:3.12-slim
COPY pyproject.toml README.md LICENSE /super-sdf/
COPY src /super-sdf/src
RUN pip install --no-cache-dir '/super-sdf[formats,report]'
WORKDIR /work
ENTRYPOINT ["super-sdf"]
CMD ["--help"]
