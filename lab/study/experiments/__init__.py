"""One module or package per experiment; `lab.study.catalogue` lists them."""
