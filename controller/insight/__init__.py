"""What a run tells afterwards: figures, pictures, the report."""
