"""A wing: from the description of a stage to a law that is designed, identified, measured and commissioned."""
