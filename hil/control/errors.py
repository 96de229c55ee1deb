"""What a design refuses: the message names the condition that is violated and what to change."""


class ControlDesignError(ValueError):
    """A condition of Theorem 1 or 2, or of the sampled model, does not hold."""
