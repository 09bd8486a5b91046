"""A run as ROS 2 topics: poses and maps for Nav2 and RViz, and commands of an operator."""
