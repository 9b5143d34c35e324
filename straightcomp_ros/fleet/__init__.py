"""A wing: the figures of every stroke of many stages over months, and the maintenance that they ask for."""
