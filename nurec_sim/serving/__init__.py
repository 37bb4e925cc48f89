"""Serving scenes over gRPC: the wire, the services, the server, the clients."""
