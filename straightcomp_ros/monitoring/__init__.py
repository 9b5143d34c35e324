"""What somebody who only watches makes of the graph's streams and diagnostics: no ROS in here."""
