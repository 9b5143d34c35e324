"""Tools for months of machines: the figures of every stroke of every bag in one store.

A store is a folder of Parquet files, which pandas, Polars and DuckDB read too. The default is `history` in the working
directory.
"""

SUMMARY = "the figures of many bags in one store, and questions to it"
TOOLS = ("add", "query", "compact", "advise", "report", "map")
