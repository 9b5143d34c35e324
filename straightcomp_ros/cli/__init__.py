"""`straightcomp …`: one module for each verb."""
