"""Reading and writing of ROS messages."""
