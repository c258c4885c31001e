"""ROS 2 without ROS: a node in a network of rmw_zenoh (docs/ros2.md).

``settings``: topics, frames, rates, buttons. ``naming``: the protocol's names and bytes. ``types``:
ROS messages of our numbers. ``node``: publishes and subscribes. The last two need rosbags.
"""
