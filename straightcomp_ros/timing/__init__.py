"""How late things were, and what was lost: measured in the running nodes, read again from a bag."""
