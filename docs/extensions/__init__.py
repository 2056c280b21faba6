"""Sphinx extensions that write the reference from the code: tables of fields, filters, help texts, formulas."""
