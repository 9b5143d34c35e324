"""What a 2 kHz rclpy node needs: loops, streams, lifecycle, parameters, scheduling."""
