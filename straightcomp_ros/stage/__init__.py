"""The description of a machine, which every node and every offline run takes its facts from."""
