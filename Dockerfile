# docker build -t damian . && docker run --rm -v $PWD/runs:/damian/runs damian            (make train)
# docker run --rm damian make test
FROM python:3.12-slim
RUN apt-get update && apt-get install --yes --no-install-recommends git make && rm -rf /var/lib/apt/lists/*
WORKDIR /damian
COPY . .
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
RUN make .venv/test
CMD ["make", "train"]
