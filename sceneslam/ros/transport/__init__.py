"""ROS 2 topics of this machine or network, as bytes: over DDS without ROS, or through rclpy."""
