MODULE Palpate
  ! label: code of the label, or 0: set the object aside
  ! fault: 0; 1: the box was never ready; 2: no answer in time; 3: FAULT; 4: the I/O unit does not answer
  PROC PalpClassify(robtarget pFrom, robtarget pTo, num tries, PERS tooldata tFinger, INOUT num label, INOUT num fault)
    VAR bool late;
    label := 0;
    fault := 0;
    PulseDO\PLength:=0.05, doPalpNew;
    WaitTime 0.1;
    FOR i FROM 1 TO tries DO
      MoveL pFrom, v50, fine, tFinger;
      WaitDI diPalpReady, 1\MaxTime:=10\TimeFlag:=late;
      IF late THEN
        fault := 1;
        RETURN;
      ENDIF
      SetDO doPalpStart, 1;
      MoveL pTo, v20, fine, tFinger; ! 3 s at least
      SetDO doPalpStop, 1;
      SetDO doPalpStart, 0;
      WaitDI diPalpValid, 1\MaxTime:=2\TimeFlag:=late;
      SetDO doPalpStop, 0;
      IF diPalpFault = 1 THEN
        fault := 3;
        RETURN;
      ENDIF
      IF late THEN
        fault := 2;
        RETURN;
      ENDIF
      label := GInput(giPalpCode);
      IF label > 0 RETURN;
      ! unsure, or no label: the same object once more
    ENDFOR
  ERROR
    IF ERRNO = ERR_NORUNUNIT THEN
      fault := 4;
      RETURN;
    ENDIF
  ENDPROC
ENDMODULE
