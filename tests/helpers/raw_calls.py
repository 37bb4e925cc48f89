"""Raw procedures of a service, for calls that our clients would not make."""


class RawCalls:
    """A channel to a server, with each procedure of a service as an attribute."""

    def __init__(self, channel, service, methods):
        self.channel = channel
        for name, method in methods.items():
            procedure = channel.unary_unary(
                f"/{service}/{name}", method.request.SerializeToString, method.reply.FromString
            )
            setattr(self, name, procedure)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.channel.close()
