# Ubuntu 24.04 with ROS 2 Jazzy and umf_ros:  docker build -t umf_ros . && docker run --rm -it --net=host umf_ros
FROM ros:jazzy-ros-base-noble
SHELL ["/bin/bash", "-c"]
RUN apt-get update -qq && apt-get install -y -qq --no-install-recommends python3-venv python3-colcon-common-extensions \
    ros-jazzy-common-interfaces ros-jazzy-lifecycle-msgs ros-jazzy-tf2-ros-py ros-jazzy-ros2launch && rm -rf /var/lib/apt/lists/*
COPY . /workspace/src/umf_ros
RUN source /opt/ros/jazzy/setup.bash && /workspace/src/umf_ros/tools/install_jazzy.sh /workspace
RUN printf '%s\n' '#!/bin/bash' 'set -e' 'source /opt/ros/jazzy/setup.bash' 'source /workspace/venv/bin/activate' \
    'source /workspace/install/setup.bash' 'exec "$@"' >/entrypoint.sh && chmod +x /entrypoint.sh
# ros2 launch ends its nodes at SIGINT; at SIGTERM it leaves them running, and their results unwritten
STOPSIGNAL SIGINT
ENTRYPOINT ["/entrypoint.sh"]
CMD ["ros2", "launch", "umf_ros", "loop_closure.launch.py"]
