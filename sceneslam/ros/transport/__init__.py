"""Publishing and subscribing to ROS 2 topics as bytes: by DDS without ROS, or by rclpy."""
