"""One module or package per experiment; `controller.study.catalogue` lists them."""
