"""New layers from formulas over layers: the language's parser and its operations."""
