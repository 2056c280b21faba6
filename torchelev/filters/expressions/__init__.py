"""The expression language of the filter chain: arithmetic over layers."""
