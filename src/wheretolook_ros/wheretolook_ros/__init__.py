"""ROS 2 nodes that localize a camera, choose where it looks, and report when it is lost."""
