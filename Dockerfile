# docker build -t vsfsim --build-arg COMMIT=$(python -m vsfsim.data.provenance) . && docker run --rm -v "$PWD/out:/out" vsfsim
FROM python:3.11-slim
ENV OMP_NUM_THREADS=1 PIP_NO_CACHE_DIR=1
WORKDIR /vsfsim
COPY . .
ARG COMMIT=""
ENV VSFSIM_COMMIT=$COMMIT
RUN pip install --extra-index-url https://download.pytorch.org/whl/cpu -c constraints.txt ".[all,cloud]"
WORKDIR /out
# the commands of the README
CMD ["sh", "-c", "vsfsim evaluate --method near-springs --method surface-gp --preset tuned --workers 4 --task fewshot-shoes-v3-mini-v1 \
  && vsfsim leaderboard --task fewshot-shoes-v3-mini-v1"]
