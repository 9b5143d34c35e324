"""What a control cycle and the running graph cost on this machine."""
