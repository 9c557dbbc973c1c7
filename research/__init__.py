"""The lab: studies with and of the benchmark. It imports the product, never the other way round (README.md)."""
