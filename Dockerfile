# The nodes with a simulated stage, for whoever wants to look without installing anything:
#   docker build -t straightcomp_ros . && docker run --rm -it straightcomp_ros
# With its picture and bag in ./demo_output, as files of yours; it compiles the control laws anew:
#   mkdir -p demo_output && docker run --rm -it --user "$(id -u):$(id -g)" -e HOME=/tmp -w /tmp \
#     -v "$PWD/demo_output:/tmp/demo_output" straightcomp_ros
# Real time, on a computer that runs nothing else: docker run --cap-add SYS_NICE --ulimit rtprio=98 --ulimit memlock=-1 …
FROM python:3.12-slim
RUN useradd --create-home straightcomp
WORKDIR /opt/straightcomp_ros
COPY package.xml setup.py setup.cfg pyproject.toml ./
COPY resource resource
COPY config config
COPY launch launch
COPY scripts scripts
COPY straightcomp_ros straightcomp_ros
RUN pip install --no-cache-dir '.[ros,tuning,fleet,opcua]'
USER straightcomp
WORKDIR /home/straightcomp
# Machine code of the control laws, kept in the user's cache.
RUN python /opt/straightcomp_ros/scripts/prepare.py
ENV ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST MPLBACKEND=agg
ENTRYPOINT ["straightcomp"]
CMD ["demo"]
