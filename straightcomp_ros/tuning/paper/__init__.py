"""The paper's figures, computed anew and put beside the numbers it prints."""
