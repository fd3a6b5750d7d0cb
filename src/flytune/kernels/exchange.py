"""Two threads in one kernel, which wait for each other's numbers: the functions in LLVM that a kernel of both contains.

A number is given from one thread to the other through a cell in memory, which is written once. No number is negative,
so -1 marks a cell that is still empty. Whether the kernel runs in two threads or in one, it does the same arithmetic
in the same functions, so the results are the same bit by bit.
"""

from collections.abc import Sequence

EMPTY = -1082130432  # the bits of -1.0
SPINS = 20  # looks at an empty cell before other threads may run on this core: few, as it may be the other one


def exchange_functions(processor: str) -> list[str]:
    """In LLVM: `empty` (cell), `publish` (source, cell) and `wait` (cell), see `Writer.call`.

    `empty` marks a cell, `publish` copies a number into it, and `wait` returns as soon as a number is in it.

    Args:
        processor: the name of the architecture with which LLVM's triple begins.
    """
    pause = ["  call void @llvm.x86.sse2.pause()"] if processor.startswith("x86_64") else []
    declared = ["declare void @llvm.x86.sse2.pause()"] if pause else []
    return [
        *declared,
        "declare i32 @sched_yield()",
        f"define internal void @empty(ptr %cell) {{\n  store i32 {EMPTY}, ptr %cell, align 4\n  ret void\n}}",
        "\n".join(
            [
                "define internal void @publish(ptr %source, ptr %cell) noinline {",
                "  %number = load i32, ptr %source, align 4",
                "  store atomic i32 %number, ptr %cell release, align 4",
                "  ret void",
                "}",
            ]
        ),
        "\n".join(
            [
                "define internal void @wait(ptr %cell) noinline {",
                "entry:",
                "  br label %look",
                "look:",
                "  %looks = phi i32 [0, %entry], [%more, %spin], [%looks, %offer]",
                "  %number = load atomic i32, ptr %cell acquire, align 4",
                f"  %missing = icmp eq i32 %number, {EMPTY}",
                "  br i1 %missing, label %again, label %end",
                "again:",
                f"  %patient = icmp ult i32 %looks, {SPINS}",
                "  br i1 %patient, label %spin, label %offer",
                "spin:",
                *pause,
                "  %more = add nuw i32 %looks, 1",
                "  br label %look",
                "offer:",
                "  %ignored = call i32 @sched_yield()",
                "  br label %look",
                "end:",
                "  ret void",
                "}",
            ]
        ),
    ]


def two_threads(name: str, buffers: Sequence[str], threads: str, parts: tuple[str, str], both: str) -> str:
    """In LLVM: a function that calls both parts in a thread each, or, in one thread, the function of both.

    It also runs in one thread where the operating system gives no second one.

    Args:
        name: of the function.
        buffers: the pointers that it takes; the parts and the function of both take the same.
        threads: the one of these pointers that leads to the number of threads that may run.
        parts: the names of two functions, which wait for each other's numbers.
        both: the name of a function that does the same as both parts.
    """
    given = ", ".join(f"ptr {buffer}" for buffer in buffers)
    places = [f"  %place{index} = getelementptr ptr, ptr %frame, i64 {index}" for index in range(len(buffers))]
    stores = [f"  store ptr {buffer}, ptr %place{index}" for index, buffer in enumerate(buffers)]
    loads = [f"  {buffer} = load ptr, ptr %place{index}" for index, buffer in enumerate(buffers)]
    return "\n".join(
        [
            "declare i32 @pthread_create(ptr, ptr, ptr, ptr)",
            "declare i32 @pthread_join(i64, ptr)",
            f"define internal ptr @{name}_thread(ptr %frame) {{",
            *places,
            *loads,
            f"  call void @{parts[1]}({given})",
            "  ret ptr null",
            "}",
            f"define internal void @{name}({given}) {{",
            f"  %frame = alloca [{len(buffers)} x ptr]",
            "  %thread = alloca i64",
            f"  %number = load i32, ptr {threads}, align 4",
            "  %many = icmp ugt i32 %number, 1",
            "  br i1 %many, label %two, label %one",
            "two:",
            *places,
            *stores,
            f"  %code = call i32 @pthread_create(ptr %thread, ptr null, ptr @{name}_thread, ptr %frame)",
            "  %failed = icmp ne i32 %code, 0",
            "  br i1 %failed, label %one, label %share",
            "share:",
            f"  call void @{parts[0]}({given})",
            "  %which = load i64, ptr %thread",
            "  %joined = call i32 @pthread_join(i64 %which, ptr null)",
            "  ret void",
            "one:",
            f"  call void @{both}({given})",
            "  ret void",
            "}",
        ]
    )
