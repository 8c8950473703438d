"""What can go wrong with a stream, apart, so that serving one needs no torch."""


class StreamError(RuntimeError):
    """A stream that cannot be written, read or fetched as asked; the message holds the remedy."""
