"""Months of machines: the figures of every recorded stroke in one store of Parquet files."""


class HistoryError(ValueError):
    """A store cannot be read or written, or a bag cannot enter it; the text says what is wrong and what helps."""


class StorageError(OSError):
    """A storage does not answer, or refuses; the text names the URL and the reason."""
