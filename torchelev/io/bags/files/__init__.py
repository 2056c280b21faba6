"""Files of bags of all formats: which ones belong together, and readers of their messages.

`opening` chooses the reader. What messages mean is read one folder above; definitions of their types are here.
"""
