"""How parameters are declared, checked, read and written."""
