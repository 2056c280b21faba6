"""The merging of many robots into a site: time, memory and bytes sent, over synthetic windows."""
