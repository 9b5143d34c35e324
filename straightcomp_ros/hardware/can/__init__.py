"""An encoder and DSP board on a CAN bus: the frames, the host's side, and an emulator of the board. No ROS."""
