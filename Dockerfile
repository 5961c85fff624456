# The image of compose.yaml: every process of a run, and the router.
#     docker compose build && docker compose up
FROM python:3.11-slim

# One user for all containers: they share the sockets and files of a run. The same number is in compose.yaml.
RUN useradd --uid 10001 --user-group --no-create-home --home-dir /tmp tenuto \
    && install --directory --owner tenuto --group tenuto /runs

WORKDIR /opt/tenuto
COPY requirements.lock .
RUN pip install --no-cache-dir --disable-pip-version-check -r requirements.lock
COPY . .
RUN pip install --no-cache-dir --disable-pip-version-check --no-deps --no-build-isolation .

# A new volume takes the owner of what it is mounted over.
VOLUME /runs
WORKDIR /runs
USER tenuto
CMD ["tenuto"]
