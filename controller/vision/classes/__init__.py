"""Classes of parts that a user teaches by showing them."""
