"""The paper's figures, computed anew and compared with the numbers it prints."""
