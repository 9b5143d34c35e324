"""`straightcomp bench | faults | soak`: one module for each verb."""
