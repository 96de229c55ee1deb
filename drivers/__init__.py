"""CAN: bus, codec and drive client. The only package that knows CAN; knows neither side of the bus."""
